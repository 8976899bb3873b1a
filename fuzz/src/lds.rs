//! Fuzzes the discovery server with arbitrary bytes from a client.

use std::cell::RefCell;

use tokio::runtime::{Builder, Runtime};

thread_local! {
    static RUNTIME: RefCell<Runtime> = RefCell::new(
        Builder::new_current_thread()
            .enable_time()
            .build()
            .expect("there is always a runtime"),
    );
}

/// Sends bytes to the server. The server responds with complete frames of the protocol, with ERR
/// only as the last frame, and with a bounded number of frames.
pub fn lds(said: &[u8]) {
    let answered = discovery::fuzz::answered(said);
    let (heard, registered) = RUNTIME.with_borrow_mut(|runtime| runtime.block_on(answered));
    let mut rest = &heard[..];
    let mut frames = 0;
    while !rest.is_empty() {
        let kind = rest.get(..4).expect("a frame begins whole");
        let size = rest.get(4..8).expect("a frame has a size");
        let size = u32::from_le_bytes(size.try_into().expect("of four bytes"));
        let size = usize::try_from(size).expect("it fits");
        assert!((8..=65_536).contains(&size), "a frame of {size} bytes");
        let after = rest.get(size..).expect("a frame ends");
        assert!(
            matches!(kind, b"ACKF" | b"OPNF" | b"MSGF" | b"MSGC" | b"ERRF"),
            "{kind:?}"
        );
        assert!(
            kind != b"ERRF" || after.is_empty(),
            "nothing comes after ERR"
        );
        frames += 1;
        rest = after;
    }
    // Each request takes a frame of more than 32 bytes; a response may have several frames.
    assert!(
        frames <= 8 + said.len(),
        "{frames} frames for {}",
        said.len()
    );
    assert!(registered <= said.len() / 32, "{registered} servers");
}

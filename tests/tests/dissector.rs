//! The Wireshark dissector in `docs/wireshark`: tshark has to show the message that was sent, and
//! to report errors in it.

mod actions;
mod messages;
mod sealed;
mod time;
mod vectors;
mod wrong;

use system_tests::{CaptureFile, Cell, Dissected, Peer};
use vectors::DissectorVector;

/// A chunk that is wrong only in its context: its bytes are equal to the bytes of a valid chunk.
const LOOKS_RIGHT: &str = "asyncua_chunk";

/// Returns tshark's view of a datagram.
fn dissected(cell: &Cell, datagram: &[u8]) -> Dissected {
    cell.dissect(&CaptureFile::of([datagram]), &[]).remove(0)
}

#[test]
fn every_vector_is_shown_as_described() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let vectors = DissectorVector::all();
    let capture = CaptureFile::of(vectors.iter().map(|vector| vector.datagram.clone()));
    let shown = cell.dissect(&capture, &[]);
    let mut differences = Vec::new();
    let mut malformed = 0;
    for (vector, shown) in vectors.iter().zip(&shown) {
        assert!(!shown.has("uadp.dissector_bug"), "{}", vector.name);
        if vector.is_malformed() && vector.name != LOOKS_RIGHT {
            assert!(shown.has("uadp.malformed"), "{}", vector.name);
            malformed += 1;
            continue;
        }
        assert!(
            !shown.has("uadp.malformed"),
            "{}: {:?}",
            vector.name,
            shown.expert_infos()
        );
        differences.extend(vector.differences(shown));
    }
    assert!(differences.is_empty(), "{}", differences.join("\n"));
    assert_eq!((vectors.len(), malformed), (195, 3));
}

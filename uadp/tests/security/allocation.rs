//! Opening and sealing allocate nothing with used buffers.

use allocation_counter::measure;
use uadp::{NetworkMessage, PublisherId, Sealer, SecurityError, SecurityMode};

use super::{START, header, keys, opener, write};

#[test]
fn opening_and_sealing_with_used_buffers_allocate_nothing() {
    for mode in [SecurityMode::Sign, SecurityMode::SignAndEncrypt] {
        let mut sealer = Sealer::new(mode);
        sealer.update_keys(1, [keys(1), keys(2)]).unwrap();
        let mut opener = opener(mode);
        opener.update_keys(1, [keys(1), keys(2)]).unwrap();
        let header = header(PublisherId::String("cell 4"), Some(5));
        let (mut datagram, mut scratch) = (Vec::new(), Vec::new());
        let mut cross = |sealer: &mut Sealer| {
            datagram.clear();
            write(&mut datagram, &header, sealer.seal([0; 4]).unwrap()).unwrap();
            let message = NetworkMessage::decode(&datagram).unwrap();
            let opened = opener.open(&message, START, &mut scratch).unwrap();
            assert_eq!(opened.message.messages().count(), 1);
            let again = opener.open(&message, START, &mut scratch).map(|_| ());
            assert!(matches!(again, Err(SecurityError::Replayed(_))));
        };
        cross(&mut sealer);
        let allocations = measure(|| (0..10).for_each(|_| cross(&mut sealer)));
        assert_eq!(allocations.count_total, 0, "{mode:?}");
    }
}

#[test]
fn opening_what_is_only_signed_needs_no_buffer() {
    let mut sealer = Sealer::new(SecurityMode::Sign);
    sealer.update_keys(1, [keys(1)]).unwrap();
    let mut opener = opener(SecurityMode::Sign);
    let header = header(PublisherId::UInt16(2), Some(5));
    let datagrams = [(); 2].map(|()| {
        let mut datagram = Vec::new();
        write(&mut datagram, &header, sealer.seal([0; 4]).unwrap()).unwrap();
        datagram
    });
    let mut open = |datagram| {
        let message = NetworkMessage::decode(datagram).unwrap();
        let mut scratch = Vec::new();
        let opened = opener.open(&message, START, &mut scratch);
        assert!(opened.is_ok());
    };
    open(&datagrams[0]);
    assert_eq!(measure(|| open(&datagrams[1])).count_total, 0);
}

//! Rules by which the kernel drops datagrams that a program does not use.

use std::collections::BTreeSet;

use socket2::SockFilter;

/// A rule for the datagrams of a layout: datagrams with an unwanted key are dropped. Datagrams of
/// another layout, and datagrams that end before the key, are not concerned.
///
/// The rule contains offsets only, because the meaning of the bytes is left to the caller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyRule {
    /// The tests that all datagrams of the layout pass.
    pub layout: Vec<ByteTest>,
    /// The offsets of the two halves of the key, which have two bytes each.
    pub key: [u16; 2],
    /// The keys of the datagrams that are received.
    pub wanted: BTreeSet<[u8; 4]>,
}

/// A test of a byte of a datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ByteTest {
    /// The offset of the byte.
    pub offset: u16,
    /// The bits that are compared.
    pub mask: u8,
    /// Their value.
    pub value: u8,
}

impl KeyRule {
    /// Returns whether the rule drops the datagram.
    #[must_use]
    pub fn drops(&self, datagram: &[u8]) -> bool {
        let byte = |offset: u16| datagram.get(usize::from(offset)).copied();
        let is_of_layout = self.layout.iter().all(|test| {
            let byte = byte(test.offset);
            byte.is_some_and(|byte| byte & test.mask == test.value)
        });
        let half = |offset: u16| Some([byte(offset)?, byte(offset.checked_add(1)?)?]);
        let [first, second] = self.key;
        match (half(first), half(second)) {
            (Some([a, b]), Some([c, d])) => is_of_layout && !self.wanted.contains(&[a, b, c, d]),
            (None, _) | (_, None) => false,
        }
    }

    /// Returns the instructions of the rule. A datagram that is neither dropped nor accepted
    /// reaches the instruction behind them.
    pub(crate) fn program(&self) -> Vec<SockFilter> {
        let decision = self.decision();
        // A load behind the end of a datagram would drop it.
        let offsets = self.layout.iter().map(|test| test.offset);
        let last = offsets.chain(self.key.map(|half| half.saturating_add(1)));
        let least = u32::from(last.max().unwrap_or_default()) + 1 + UDP_HEADER;
        let mut tests = vec![
            SockFilter::new(LOAD_LENGTH, 0, 0, 0),
            SockFilter::new(JUMP_IF_AT_LEAST, 1, 0, least),
        ];
        let mut exits = vec![tests.len()];
        tests.push(SockFilter::new(JUMP, 0, 0, 0));
        for test in &self.layout {
            tests.extend([
                SockFilter::new(LOAD_BYTE, 0, 0, at(test.offset)),
                SockFilter::new(AND, 0, 0, test.mask.into()),
                SockFilter::new(JUMP_IF_EQUAL, 1, 0, test.value.into()),
            ]);
            exits.push(tests.len());
            tests.push(SockFilter::new(JUMP, 0, 0, 0));
        }
        let whole = tests.len() + decision.len();
        for exit in exits {
            let past = u32::try_from(whole.saturating_sub(exit + 1)).unwrap_or(u32::MAX);
            if let Some(jump) = tests.get_mut(exit) {
                *jump = SockFilter::new(JUMP, 0, 0, past);
            }
        }
        tests.extend(decision);
        tests
    }

    /// Returns the instructions that accept the wanted keys and drop all others.
    fn decision(&self) -> Vec<SockFilter> {
        let [first, second] = self.key.map(at);
        let mut decision = vec![
            SockFilter::new(LOAD_HALF, 0, 0, first),
            SockFilter::new(SHIFT_LEFT, 0, 0, 16),
            SockFilter::new(COPY_TO_X, 0, 0, 0),
            SockFilter::new(LOAD_HALF, 0, 0, second),
            SockFilter::new(OR_X, 0, 0, 0),
        ];
        for key in &self.wanted {
            decision.extend([
                SockFilter::new(JUMP_IF_EQUAL, 0, 1, u32::from_be_bytes(*key)),
                SockFilter::new(RETURN, 0, 0, ACCEPT),
            ]);
        }
        decision.push(SockFilter::new(RETURN, 0, 0, DROP));
        decision
    }
}

/// Returns the offset of a byte for the kernel, which counts from the UDP header on.
fn at(offset: u16) -> u32 {
    u32::from(offset) + UDP_HEADER
}

// Instructions of classic BPF, see `Documentation/networking/filter.rst` of Linux.
pub(crate) const LOAD_HALF: u16 = 0x28;
pub(crate) const JUMP_IF_EQUAL: u16 = 0x15;
pub(crate) const JUMP: u16 = 0x05;
pub(crate) const RETURN: u16 = 0x06;
const LOAD_BYTE: u16 = 0x30;
const LOAD_LENGTH: u16 = 0x80;
const JUMP_IF_AT_LEAST: u16 = 0x35;
const AND: u16 = 0x54;
const SHIFT_LEFT: u16 = 0x64;
const OR_X: u16 = 0x4c;
const COPY_TO_X: u16 = 0x07;
/// The maximum number of bytes to accept.
pub(crate) const ACCEPT: u32 = u32::MAX;
pub(crate) const DROP: u32 = 0;
/// Bytes of the header before the payload of a UDP datagram.
const UDP_HEADER: u32 = 8;

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;
    use std::time::Duration;

    use socket2::SockRef;

    use super::*;

    fn rule(wanted: &[[u8; 4]]) -> KeyRule {
        let test = |offset, mask, value| ByteTest {
            offset,
            mask,
            value,
        };
        KeyRule {
            layout: vec![test(0, 0xF0, 0xB0), test(1, 0xFF, 0x01)],
            key: [2, 5],
            wanted: wanted.iter().copied().collect(),
        }
    }

    /// Returns the datagrams that the kernel passes.
    fn received(program: &[SockFilter], datagrams: &[Vec<u8>]) -> Vec<Vec<u8>> {
        let receiver = UdpSocket::bind("127.0.0.1:0").unwrap();
        let timeout = Some(Duration::from_secs(10));
        receiver.set_read_timeout(timeout).unwrap();
        SockRef::from(&receiver).attach_filter(program).unwrap();
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        sender.connect(receiver.local_addr().unwrap()).unwrap();
        let last = b"last".to_vec();
        let mut received = Vec::new();
        for datagram in datagrams.iter().chain([&last]) {
            sender.send(datagram).unwrap();
        }
        let mut buffer = [0; 64];
        loop {
            let length = receiver.recv(&mut buffer).unwrap();
            let datagram = buffer[..length].to_vec();
            if datagram == last {
                return received;
            }
            received.push(datagram);
        }
    }

    #[test]
    fn the_kernel_drops_the_datagrams_that_the_rule_drops_and_no_others() {
        let key = |id: u16| {
            let [high, low] = id.to_be_bytes();
            [0, 0, high, low]
        };
        let many: Vec<[u8; 4]> = (0..300).map(key).collect();
        let datagrams: Vec<Vec<u8>> = [
            // Wanted keys.
            &[0xB1, 1, 0, 0, 9, 0, 7, 1, 2][..],
            &[0xB1, 1, 0, 0, 9, 1, 20],
            // Other keys.
            &[0xB1, 1, 0, 0, 9, 2, 7, 1, 2],
            &[0xB1, 1, 0, 1, 9, 0, 7],
            &[0xBF, 1, 9, 9, 9, 9, 9],
            // Other layouts, and too short.
            &[0x91, 1, 0, 0, 9, 2, 7],
            &[0xB1, 2, 0, 0, 9, 2, 7],
            &[0xB1, 1, 0, 1, 9, 2],
            &[0xB1],
            &[],
        ]
        .map(<[u8]>::to_vec)
        .to_vec();
        for rule in [rule(&[]), rule(&[[0, 0, 0, 7]]), rule(&many)] {
            let passed = |datagram: &&Vec<u8>| !rule.drops(datagram);
            let expected: Vec<Vec<u8>> = datagrams.iter().filter(passed).cloned().collect();
            let mut program = rule.program();
            program.push(SockFilter::new(RETURN, 0, 0, ACCEPT));
            assert_eq!(received(&program, &datagrams), expected, "{rule:?}");
        }
        let dropped = |wanted: &[[u8; 4]]| {
            let rule = rule(wanted);
            datagrams.iter().filter(|one| rule.drops(one)).count()
        };
        assert_eq!([dropped(&[]), dropped(&many)], [5, 3]);
    }
}

//! Texts with a number and a checksum, as the DDS peers send and check them.

use std::collections::BTreeSet;

/// Returns the text of `size` characters for `number`: its eight decimal digits, the FNV-1a hash of
/// number and filler in hexadecimal, and filler.
///
/// # Panics
/// Panics if `size` is below 18 or `number` has more than eight digits.
#[must_use]
pub fn numbered(number: u32, size: usize) -> String {
    assert!(number < 100_000_000, "{number}");
    let filler: String = (0..size.checked_sub(HEAD).unwrap())
        .map(|at| char::from(b'a' + ((at * 7 + number as usize) % 26) as u8))
        .collect();
    format!("{number:08} {:08x} {filler}", sum(number, &filler))
}

/// The set of numbered texts that were received.
#[derive(Debug, Default)]
pub struct Numbered {
    heard: BTreeSet<u32>,
    /// Number of texts received more than once.
    pub repeated: usize,
    /// Number of texts that differ from the text that was sent.
    pub bad: usize,
}

impl Numbered {
    /// Adds a text. A text without a number is ignored.
    pub fn add(&mut self, text: &str) {
        let number = text.get(..8).and_then(|number| number.parse().ok());
        let Some(number) = number.filter(|_| text.len() >= HEAD) else {
            return;
        };
        if numbered(number, text.len()) != text {
            self.bad += 1;
        } else if !self.heard.insert(number) {
            self.repeated += 1;
        }
    }

    /// Returns the number of different intact texts received.
    #[must_use]
    pub fn len(&self) -> usize {
        self.heard.len()
    }

    /// Returns whether no intact text was received.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.heard.is_empty()
    }

    /// Returns the numbers below `count` that were not received.
    #[must_use]
    pub fn missing(&self, count: u32) -> Vec<u32> {
        (0..count)
            .filter(|number| !self.heard.contains(number))
            .collect()
    }
}

const HEAD: usize = 18;

fn sum(number: u32, filler: &str) -> u32 {
    let bytes = number.to_le_bytes().into_iter().chain(filler.bytes());
    bytes.fold(2_166_136_261, |hash, byte| {
        (hash ^ u32::from(byte)).wrapping_mul(16_777_619)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_is_as_the_peers_in_c_make_it() {
        // The text that `cyclone-peer pub --size 24 --first 7` sends.
        assert_eq!(numbered(7, 24), "00000007 b8cfe161 hovcjq");
    }

    #[test]
    fn a_changed_text_is_bad_and_a_second_one_repeated() {
        let mut all = Numbered::default();
        for text in [
            numbered(1, 30),
            numbered(1, 30),
            numbered(2, 30).replace('c', "x"),
            "hello".into(),
        ] {
            all.add(&text);
        }
        assert_eq!((all.len(), all.repeated, all.bad), (1, 1, 1));
        assert_eq!(all.missing(3), [0, 2]);
    }
}

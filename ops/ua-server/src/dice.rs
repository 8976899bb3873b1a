//! Reproducible sequences of numbers for tests.

/// A sequence of numbers (xorshift).
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    /// Returns the next number, below the number of sides.
    pub(crate) fn below(&mut self, sides: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % sides
    }
}

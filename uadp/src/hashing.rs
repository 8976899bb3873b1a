//! Hashers and tables of the standard library, and replacements without it.

#[cfg(feature = "std")]
pub(crate) use std::collections::{HashMap, HashSet};
#[cfg(feature = "std")]
pub(crate) use std::hash::DefaultHasher;

#[cfg(not(feature = "std"))]
pub(crate) use alloc::collections::{BTreeMap as HashMap, BTreeSet as HashSet};
#[cfg(not(feature = "std"))]
pub(crate) use core_hasher::DefaultHasher;

/// The hasher of the core library, SipHash 2-4.
#[cfg(not(feature = "std"))]
#[expect(deprecated, reason = "the core library has no other hasher")]
mod core_hasher {
    use core::hash::{Hasher, SipHasher};

    #[derive(Debug)]
    pub(crate) struct DefaultHasher(SipHasher);

    impl DefaultHasher {
        pub(crate) fn new() -> Self {
            Self(SipHasher::new())
        }
    }

    impl Hasher for DefaultHasher {
        fn finish(&self) -> u64 {
            self.0.finish()
        }

        fn write(&mut self, bytes: &[u8]) {
            self.0.write(bytes);
        }
    }
}

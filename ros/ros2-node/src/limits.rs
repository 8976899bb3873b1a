//! The version of RustDDS that carries the samples, and the largest sample that it delivers.
//!
//! The published RustDDS repairs lost fragments so slowly that a large sample never becomes
//! complete if its burst overflows the receiver's socket buffer. The patches in `patches/` change
//! that; `cargo xtask` builds with them.

use crate::graph::RemoteEndpoint;

/// True with the patched RustDDS.
pub const PATCHED: bool = cfg!(feature = "patched-dds");

/// The version and the limits of RustDDS, for log messages.
pub const RUSTDDS: &str = if PATCHED {
    "RustDDS 0.15.1 with 61 patches, samples up to 10 MB"
} else {
    "RustDDS 0.15.1 as published, samples up to 256 kB to Fast DDS, 2 MB to others"
};

/// Whether DDS Security is supported, for log messages and versions.
pub const SECURITY: &str = if cfg!(feature = "security") {
    "with DDS Security"
} else {
    "without DDS Security"
};

/// Returns the size in bytes of the largest serialized sample that all readers with the system's
/// default socket buffers receive. A larger sample is not written, but refused
/// ([`OutletRefusal::TooLarge`](crate::outlet::OutletRefusal::TooLarge)).
#[must_use]
pub fn sample_size(readers: &[RemoteEndpoint]) -> usize {
    if readers.iter().any(RemoteEndpoint::is_fast_dds) {
        TO_FAST_DDS
    } else {
        TO_OTHERS
    }
}

/// The largest sample for unknown readers.
pub const TO_ANY: usize = if TO_FAST_DDS < TO_OTHERS {
    TO_FAST_DDS
} else {
    TO_OTHERS
};

#[cfg(feature = "patched-dds")]
mod sizes {
    /// Measured: 30 of 30 samples of this size, reliable.
    pub(super) const TO_FAST_DDS: usize = 10 * 1024 * 1024;
    /// Measured with the same result.
    pub(super) const TO_OTHERS: usize = 10 * 1024 * 1024;
}

#[cfg(not(feature = "patched-dds"))]
mod sizes {
    /// Measured: one sample in ten of 1 MiB reached a Fast DDS reader, and all of 262 kB did.
    pub(super) const TO_FAST_DDS: usize = 256 * 1024;
    /// Measured: Cyclone DDS readers received 2 MiB and lost 3 MiB.
    pub(super) const TO_OTHERS: usize = 2 * 1024 * 1024;
}

use sizes::{TO_FAST_DDS, TO_OTHERS};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_text_names_the_version_that_is_locked() {
        let lock = include_str!("../../../Cargo.lock");
        let (_, package) = lock.split_once("name = \"rustdds\"\nversion = \"").unwrap();
        let (version, _) = package.split_once('"').unwrap();
        assert!(
            RUSTDDS.starts_with(&format!("RustDDS {version} ")),
            "{version}"
        );
    }

    #[cfg(feature = "patched-dds")]
    #[test]
    fn the_text_counts_the_patches() {
        let own = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
        let folder = own.join("../../patches/rustdds-0.15.1");
        let count = std::fs::read_dir(folder)
            .unwrap()
            .filter(|entry| {
                entry
                    .as_ref()
                    .is_ok_and(|entry| entry.path().extension().is_some_and(|e| e == "patch"))
            })
            .count();
        assert!(RUSTDDS.contains(&format!(" with {count} patches,")));
    }

    #[test]
    fn the_text_names_the_limits() {
        let size = |bytes: usize| match bytes / (1024 * 1024) {
            0 => format!("{} kB", bytes / 1024),
            mega => format!("{mega} MB"),
        };
        for limit in [TO_FAST_DDS, TO_OTHERS] {
            assert!(RUSTDDS.contains(&size(limit)), "{limit}");
        }
    }
}

//! Compares passwords with their hashes in bounded memory.

use argon2::password_hash::phc::{Output, PasswordHash};
use argon2::{Algorithm, Argon2, Block, Params, Version};

/// Returns whether a password has this argon2 hash, in the PHC format.
pub(super) fn has_hash(password: &[u8], hash: &str) -> bool {
    compared(password, hash).unwrap_or(false)
}

/// Compares a password with a hash; `None` for an invalid hash.
fn compared(password: &[u8], hash: &str) -> Option<bool> {
    let hash = PasswordHash::new(hash).ok()?;
    let (salt, wanted) = (hash.salt.as_ref()?, hash.hash.as_ref()?);
    let algorithm: Algorithm = hash.algorithm.as_str().parse().ok()?;
    let version = match hash.version {
        Some(version) => Version::try_from(version).ok()?,
        None => Version::default(),
    };
    let params = Params::try_from(&hash).ok()?;
    let blocks = params.block_count();
    let mut memory: Vec<Block> = Vec::with_capacity(blocks.max(LEAST_BLOCKS));
    memory.resize(blocks, Block::new());
    let mut output = vec![0; wanted.as_bytes().len()];
    Argon2::new(algorithm, version, params)
        .hash_password_into_with_memory(password, salt, &mut output, memory.as_mut_slice())
        .ok()?;
    // The comparison takes constant time.
    Some(Output::new(&output).ok()? == *wanted)
}

/// The GNU C library returns a freed allocation to the operating system only above 32 MiB. It keeps
/// smaller allocations in an arena per thread. Blocks beyond the blocks of the hash are never
/// touched and use no memory.
const LEAST_BLOCKS: usize = (33 << 20) / Block::SIZE;

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use super::super::{Credential, hashed};
    use super::*;

    fn resident() -> usize {
        let statm = std::fs::read_to_string("/proc/self/statm").unwrap();
        let pages: usize = statm.split(' ').nth(1).unwrap().parse().unwrap();
        pages * 4096
    }

    #[test]
    fn the_memory_of_a_check_is_given_back() {
        let Ok(Credential::Password(hash)) = hashed(b"correct horse") else {
            panic!("no hash");
        };
        assert!(has_hash(b"correct horse", &hash));
        assert!(!has_hash(b"correct house", &hash));
        assert!(!has_hash(b"correct horse", "$argon2id$x"));
        let before = resident();
        let barrier = Barrier::new(THREADS + 1);
        std::thread::scope(|scope| {
            for _ in 0..THREADS {
                scope.spawn(|| {
                    for _ in 0..2 {
                        assert!(has_hash(b"correct horse", &hash));
                    }
                    // The arenas of these threads exist while the memory is measured.
                    barrier.wait();
                    barrier.wait();
                });
            }
            barrier.wait();
            let grown = resident().saturating_sub(before);
            barrier.wait();
            assert!(grown < 30 << 20, "{grown} bytes");
        });
    }

    const THREADS: usize = 8;
}

//! File descriptors of the process: each endpoint of RustDDS takes some, and topics invented by
//! other nodes must leave some free.

use std::fs::File;
use std::os::fd::AsRawFd;

use rustix::process::{Resource, getrlimit};

/// The file descriptors of this process.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Descriptors {
    limit: usize,
}

/// The number of endpoints for which file descriptors are free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct FreeDescriptors {
    /// For topics of the mapping, services and actions.
    pub(crate) mapped: usize,
    /// For topics that the mapping does not name. A quarter of all descriptors is reserved for
    /// other endpoints.
    pub(crate) found: usize,
}

impl Descriptors {
    /// Reads the current limit of this process (`RLIMIT_NOFILE`).
    pub(crate) fn of_process() -> Self {
        let limit = getrlimit(Resource::Nofile).current;
        Self {
            limit: limit.map_or(usize::MAX, |limit| limit.try_into().unwrap_or(usize::MAX)),
        }
    }

    pub(crate) const fn limit(self) -> usize {
        self.limit
    }

    /// Returns the number of endpoints for which descriptors are free. The lowest free descriptor
    /// shows how many are open.
    pub(crate) fn free(self) -> FreeDescriptors {
        let open = File::open("/dev/null").map(|file| file.as_raw_fd());
        // Without a free descriptor, the file cannot be opened.
        let open = open.ok().and_then(|open| usize::try_from(open).ok());
        self.free_beside(open.unwrap_or(self.limit))
    }

    const fn free_beside(self, open: usize) -> FreeDescriptors {
        let left = self.limit.saturating_sub(open);
        FreeDescriptors {
            mapped: left.saturating_sub(RESERVE) / OF_ENDPOINT,
            found: left.saturating_sub(self.limit / 4) / OF_ENDPOINT,
        }
    }
}

/// Descriptors that RustDDS opens for an endpoint: two pairs of sockets, and sometimes another
/// descriptor. Measured: 217 readers in 1000.
const OF_ENDPOINT: usize = 5;
/// Descriptors reserved for status pages, files and the sockets of the space.
const RESERVE: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_others_name_leaves_a_quarter_of_the_descriptors_to_the_mapping() {
        let descriptors = Descriptors { limit: 1024 };
        let free = |open| descriptors.free_beside(open);
        assert_eq!(
            free(24),
            FreeDescriptors {
                mapped: 187,
                found: 148
            }
        );
        assert_eq!(
            free(768),
            FreeDescriptors {
                mapped: 38,
                found: 0
            }
        );
        assert_eq!(
            free(960),
            FreeDescriptors {
                mapped: 0,
                found: 0
            }
        );
        assert_eq!(
            free(5_000),
            FreeDescriptors {
                mapped: 0,
                found: 0
            }
        );
    }

    #[test]
    fn open_descriptors_are_counted() {
        let descriptors = Descriptors { limit: 1_000_000 };
        let before = descriptors.free();
        let open: Vec<_> = (0..120).map(|_| File::open("/dev/null").unwrap()).collect();
        assert!(descriptors.free().mapped < before.mapped, "{}", open.len());
    }
}

//! The limit of open files and connections of the program.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tracing::debug;

/// Raises the limit to at most 65 536, as far as the system permits. The usual limit of a shell
/// is 1024, for programs that use `select`; a graph of 500 topics needs more.
pub fn raise() {
    let limit = getrlimit(Resource::Nofile);
    let most = limit.maximum.map_or(MOST, |maximum| maximum.min(MOST));
    if limit.current.is_none_or(|current| current >= most) {
        return;
    }
    let raised = Rlimit {
        current: Some(most),
        maximum: limit.maximum,
    };
    if let Err(error) = setrlimit(Resource::Nofile, raised) {
        debug!(%error, "cannot raise the limit of open files");
    }
}

const MOST: u64 = 65_536;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_is_raised_to_what_the_system_allows() {
        let Rlimit { maximum, .. } = getrlimit(Resource::Nofile);
        let most = maximum.map_or(MOST, |maximum| maximum.min(MOST));
        let current = Some(most - 1);
        setrlimit(Resource::Nofile, Rlimit { current, maximum }).unwrap();
        raise();
        assert_eq!(getrlimit(Resource::Nofile).current, Some(most));
    }
}

//! ConfigurationVersion: which DataSetMetaData describes a DataSetMessage (OPC 10000-14, 6.2.3.2.6).

/// When the content of a DataSet last changed: VersionTimes, seconds since 2000-01-01 UTC
/// (OPC 10000-14, 6.2.3.2.6).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct ConfigurationVersion {
    /// The last change that is more than fields added at the end.
    pub major: u32,
    /// The last change at all.
    pub minor: u32,
}

impl ConfigurationVersion {
    /// The version after fields were removed, reordered, put in between or given another DataType, or a Property of
    /// a field changed: both numbers are `at`, or the smallest that is new when `at` is not.
    #[must_use]
    pub fn changed(self, at: u32) -> Self {
        let at = self.later(at);
        Self {
            major: at,
            minor: at,
        }
    }

    /// The version after fields were added at the end: the minor number is `at`, or the smallest that is new.
    #[must_use]
    pub fn extended(self, at: u32) -> Self {
        Self {
            major: self.major,
            minor: self.later(at),
        }
    }

    /// Two changes within a second, or a clock that was set back, would give a version that was used before.
    fn later(self, at: u32) -> u32 {
        at.max(self.major.max(self.minor).saturating_add(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_major_change_sets_both_numbers_and_a_minor_one_only_the_minor() {
        let version = ConfigurationVersion {
            major: 100,
            minor: 120,
        };
        let changed = ConfigurationVersion {
            major: 200,
            minor: 200,
        };
        assert_eq!(version.changed(200), changed);
        let extended = ConfigurationVersion {
            major: 100,
            minor: 200,
        };
        assert_eq!(version.extended(200), extended);
    }

    #[test]
    fn a_version_is_never_used_twice_when_the_clock_stands_or_goes_back() {
        let version = ConfigurationVersion {
            major: 100,
            minor: 120,
        };
        assert_eq!(version.extended(120).minor, 121);
        assert_eq!(version.extended(5).minor, 121);
        assert_eq!(version.changed(120).major, 121);
    }
}

//! ConfigurationVersion: the relation of DataSetMetaData and DataSetMessages (OPC 10000-14,
//! 6.2.3.2.6).

/// Time of the last change to the content of a DataSet. Both versions are VersionTimes, in seconds
/// since 2000-01-01 UTC (OPC 10000-14, 6.2.3.2.6).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct ConfigurationVersion {
    /// Last change other than fields added at the end.
    pub major: u32,
    /// Last change of any kind.
    pub minor: u32,
}

impl ConfigurationVersion {
    /// Returns the version after a major change: fields removed, reordered or inserted, another
    /// DataType, or a changed Property of a field. Both numbers are `at`, or the smallest new
    /// number if `at` is not new.
    #[must_use]
    pub fn changed(self, at: u32) -> Self {
        let at = self.later(at);
        Self {
            major: at,
            minor: at,
        }
    }

    /// Returns the version after fields were added at the end: the minor number is `at`, or the
    /// smallest new number.
    #[must_use]
    pub fn extended(self, at: u32) -> Self {
        Self {
            major: self.major,
            minor: self.later(at),
        }
    }

    /// Returns a new version time. It differs from `at` for two changes within a second or after
    /// the clock was set back, which would repeat an earlier version.
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

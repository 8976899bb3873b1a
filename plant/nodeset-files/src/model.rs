//! The model of a NodeSet, and the order of its versions.

use std::fmt;

/// The model of a NodeSet.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeSetModel {
    /// Its URI, which is that of its namespace.
    pub namespace: String,
    /// Its version.
    pub version: ModelVersion,
    /// The models that it requires, with the oldest versions that suffice.
    pub required: Vec<(String, ModelVersion)>,
}

/// The version of a model.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ModelVersion {
    /// The version for people; empty if unknown.
    pub version: String,
    /// The date as in the file; empty if unknown.
    pub publication_date: String,
}

impl ModelVersion {
    /// Returns whether this version is older than another version: by the dates if both are known,
    /// otherwise by the numbers of the versions. `false` if that cannot be decided.
    #[must_use]
    pub fn is_older_than(&self, other: &Self) -> bool {
        match (self.day(), other.day()) {
            (Some(own), Some(other)) => own < other,
            _ => match (self.numbers(), other.numbers()) {
                (Some(own), Some(other)) => own < other,
                _ => false,
            },
        }
    }

    /// Returns the date without the time, as `2022-11-03`.
    fn day(&self) -> Option<&str> {
        let day = self.publication_date.trim().get(..10)?;
        let is_date = day.bytes().enumerate().all(|(at, byte)| match at {
            4 | 7 => byte == b'-',
            _ => byte.is_ascii_digit(),
        });
        is_date.then_some(day)
    }

    fn numbers(&self) -> Option<Vec<u32>> {
        let parts = self.version.trim().split('.');
        let mut numbers: Vec<u32> = parts.map(|part| part.parse().ok()).collect::<Option<_>>()?;
        while numbers.last() == Some(&0) {
            numbers.pop();
        }
        Some(numbers)
    }
}

impl fmt::Display for ModelVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.version.trim(), self.day()) {
            ("", None) => f.write_str("unknown version"),
            ("", Some(day)) => write!(f, "version of {day}"),
            (version, None) => write!(f, "version {version}"),
            (version, Some(day)) => write!(f, "version {version} of {day}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn version(version: &str, date: &str) -> ModelVersion {
        ModelVersion {
            version: version.to_owned(),
            publication_date: date.to_owned(),
        }
    }

    #[test]
    fn versions_are_compared_by_their_dates_and_then_by_their_numbers() {
        let of_2021 = version("2.0", "2021-05-20T00:00:00Z");
        let of_2022 = version("1.04.0", "2022-11-03T00:00:00.000Z");
        assert!(of_2021.is_older_than(&of_2022));
        assert!(!of_2022.is_older_than(&of_2021));
        assert!(
            !of_2022.is_older_than(&version("", "2022-11-03")),
            "the same day"
        );
        assert!(version("1.9", "").is_older_than(&version("1.10.0", "2022-11-03")));
        assert!(!version("1.4", "").is_older_than(&version("1.04.0", "")));
        for unknown in [version("", ""), version("beta", "soon")] {
            assert!(!unknown.is_older_than(&of_2022) && !of_2022.is_older_than(&unknown));
        }
        assert_eq!(of_2022.to_string(), "version 1.04.0 of 2022-11-03");
    }
}

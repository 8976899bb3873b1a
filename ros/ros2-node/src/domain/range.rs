//! How far a participant is discovered.

use std::net::{IpAddr, Ipv4Addr};

use super::DomainError;

/// The discovery range, as set in the ROS environment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DiscoveryRange {
    /// The reach of multicast.
    Subnet,
    /// This machine only.
    Localhost,
}

impl DiscoveryRange {
    /// Reads the values of `ROS_AUTOMATIC_DISCOVERY_RANGE` and of its predecessor
    /// `ROS_LOCALHOST_ONLY`, which takes precedence when it is `1`, as in rcl.
    ///
    /// # Errors
    /// [`DomainError::DiscoveryRange`] for a range that no bridge can use, or that ROS does not
    /// define.
    pub fn from_env(
        range: Option<&str>,
        localhost_only: Option<&str>,
    ) -> Result<Self, DomainError> {
        if localhost_only == Some("1") {
            return Ok(Self::Localhost);
        }
        match range {
            None | Some("" | "SUBNET" | "SYSTEM_DEFAULT") => Ok(Self::Subnet),
            Some("LOCALHOST") => Ok(Self::Localhost),
            Some(other) => Err(DomainError::DiscoveryRange(other.to_owned())),
        }
    }

    /// Returns the addresses to use if no interface was chosen.
    #[must_use]
    pub fn networks(self) -> Vec<IpAddr> {
        match self {
            Self::Subnet => Vec::new(),
            Self::Localhost => vec![IpAddr::V4(Ipv4Addr::LOCALHOST)],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_older_variable_wins_as_in_rcl() {
        assert_eq!(
            DiscoveryRange::from_env(Some("SUBNET"), Some("1")).unwrap(),
            DiscoveryRange::Localhost
        );
        assert_eq!(
            DiscoveryRange::from_env(Some("LOCALHOST"), Some("0")).unwrap(),
            DiscoveryRange::Localhost
        );
        assert_eq!(
            DiscoveryRange::from_env(None, None).unwrap(),
            DiscoveryRange::Subnet
        );
    }

    #[test]
    fn a_range_without_discovery_is_refused_by_name() {
        let error = DiscoveryRange::from_env(Some("OFF"), None).unwrap_err();
        assert!(error.to_string().contains("`OFF`"), "{error}");
    }
}

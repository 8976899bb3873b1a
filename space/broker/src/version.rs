//! The protocol version of the next connection.

use mappings::MqttVersion;

/// The version of MQTT that the broker accepts.
#[derive(Debug, Clone, Copy)]
pub(crate) struct VersionChoice {
    next: MqttVersion,
    /// Whether the mapping sets the version.
    is_fixed: bool,
    /// Whether a broker has accepted the version.
    is_accepted: bool,
    /// Number of connections in a row that the broker closed without a response.
    silent: u32,
}

/// The response of a broker to the version of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum VersionResponse {
    /// The broker accepted the connection.
    Accepted,
    /// The broker refused the version.
    Refused,
    /// The broker closed the connection without a response.
    Silent,
    /// The broker refused the connection for another reason, or is not there.
    Unknown,
}

impl VersionChoice {
    /// Begins with the version of the mapping, or else with MQTT 5.
    pub(crate) fn new(version: Option<MqttVersion>) -> Self {
        Self {
            next: version.unwrap_or(MqttVersion::V5),
            is_fixed: version.is_some(),
            is_accepted: false,
            silent: 0,
        }
    }

    pub(crate) const fn next(self) -> MqttVersion {
        self.next
    }

    /// Evaluates the response of the broker. A cluster without a leader closes connections without
    /// a response, so a version that was accepted before is kept for some of them.
    pub(crate) fn ended(&mut self, response: VersionResponse) {
        let is_other = match response {
            VersionResponse::Accepted => {
                self.is_accepted = true;
                self.silent = 0;
                false
            }
            VersionResponse::Refused => true,
            VersionResponse::Silent => {
                self.silent += 1;
                !self.is_accepted || self.silent >= MAX_SILENT
            }
            VersionResponse::Unknown => false,
        };
        if is_other && !self.is_fixed {
            self.is_accepted = false;
            self.silent = 0;
            self.next = match self.next {
                MqttVersion::V5 => MqttVersion::V3_1_1,
                MqttVersion::V3_1_1 => MqttVersion::V5,
            };
        }
    }
}

/// Number of connections without a response after which the other version is tried.
const MAX_SILENT: u32 = 4;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_other_version_follows_a_refusal_and_a_broker_that_never_responds() {
        for response in [VersionResponse::Refused, VersionResponse::Silent] {
            let mut version = VersionChoice::new(None);
            assert_eq!(version.next(), MqttVersion::V5);
            version.ended(VersionResponse::Unknown);
            assert_eq!(version.next(), MqttVersion::V5);
            version.ended(response);
            assert_eq!(version.next(), MqttVersion::V3_1_1);
            version.ended(response);
            assert_eq!(version.next(), MqttVersion::V5);
        }
        let mut fixed = VersionChoice::new(Some(MqttVersion::V3_1_1));
        fixed.ended(VersionResponse::Refused);
        assert_eq!(fixed.next(), MqttVersion::V3_1_1);
    }

    #[test]
    fn an_accepted_version_is_kept_while_a_cluster_elects_a_leader_but_not_for_ever() {
        let mut version = VersionChoice::new(None);
        version.ended(VersionResponse::Refused);
        version.ended(VersionResponse::Accepted);
        for _ in 1..MAX_SILENT {
            version.ended(VersionResponse::Silent);
            assert_eq!(version.next(), MqttVersion::V3_1_1);
        }
        version.ended(VersionResponse::Silent);
        assert_eq!(version.next(), MqttVersion::V5);
    }
}

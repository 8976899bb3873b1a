//! Services: one request, one reply, as bytes of any type, with servers and clients of any vendor.
//!
//! A service `/name` is two topics, `rq/nameRequest` and `rr/nameReply` (design.ros2.org, "Topic and Service name
//! mapping to DDS"). Requests and replies are CDR with their encapsulation header; how they are tied together is
//! [`ServiceMapping`].

mod audience;
mod client;
mod error;
mod mapping;
mod met;
mod opening;
mod pace;
pub(crate) mod peers;
mod server;

use std::future::poll_fn;
use std::task::Poll;
use std::time::Duration;

use messages::{ServiceTypeHashes, TypeName};
use rustdds::policy::{Durability, History, ResourceLimits};
use rustdds::{QosPolicies, QosPolicyBuilder};

pub use self::client::{ServiceClient, ServiceClientOptions};
pub use self::error::{CallPhase, ServiceError};
pub use self::mapping::ServiceMapping;
pub use self::peers::ServicePeers;
pub use self::server::{ServiceCounters, ServiceOptions, ServiceRequest, ServiceServer};

pub(crate) use self::audience::Audience;
pub(crate) use self::client::{Recall, Replied};
pub(crate) use self::mapping::Received;
pub(crate) use self::opening::Opening;
pub(crate) use self::peers::{Snapshot, action_type, service_type};
pub(crate) use self::server::{Answer, Never};
use crate::domain::Domain;
use crate::raw::Reader;

/// The DDS types of a service's two topics.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceTypes {
    /// Such as `std_srvs::srv::dds_::SetBool_Request_`.
    pub request: String,
    /// Such as `std_srvs::srv::dds_::SetBool_Response_`.
    pub response: String,
}

impl ServiceTypes {
    /// Of a `.srv` file.
    #[must_use]
    pub fn of(service: &TypeName) -> Self {
        let of = |half| {
            format!(
                "{}::srv::dds_::{}_{half}_",
                service.package(),
                service.name()
            )
        };
        Self {
            request: of("Request"),
            response: of("Response"),
        }
    }
}

/// A service by name and type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Service {
    /// The ROS name, `/arm/grip`.
    pub name: String,
    /// Its types.
    pub types: ServiceTypes,
}

impl Service {
    /// The service of that name, of the type of a `.srv` file.
    #[must_use]
    pub fn new(name: &str, service_type: &TypeName) -> Self {
        Self {
            name: name.to_owned(),
            types: ServiceTypes::of(service_type),
        }
    }

    /// Has the domain announce the hashes of the types, for endpoints that are made from now on.
    pub(crate) fn announce(&self, domain: &Domain, hashes: &ServiceTypeHashes) {
        domain.learn_type_hash(&self.types.request, hashes.request.to_string());
        domain.learn_type_hash(&self.types.response, hashes.response.to_string());
    }

    /// The DDS topic with the requests.
    #[must_use]
    pub fn request_topic(&self) -> String {
        format!("rq/{}Request", self.name.trim_start_matches('/'))
    }

    /// The DDS topic with the replies.
    #[must_use]
    pub fn reply_topic(&self) -> String {
        format!("rr/{}Reply", self.name.trim_start_matches('/'))
    }
}

/// Reliable and volatile, as rmw's default for services. Depths are no part of discovery; ours is longer than the 10
/// of rmw, so that a burst of calls is kept.
pub(crate) fn policies() -> QosPolicies {
    QosPolicyBuilder::new()
        .reliable(rustdds::Duration::ZERO)
        .durability(Durability::Volatile)
        .history(History::KeepLast { depth: DEPTH })
        .resource_limits(ResourceLimits {
            max_samples: WINDOW,
            max_instances: 1,
            max_samples_per_instance: WINDOW,
        })
        .build()
}

/// The next sample, or `None` for one that cannot be read. Cancel-safe: a sample is taken only when it is returned.
pub(crate) async fn next(reader: &Reader) -> Option<Received> {
    poll_fn(|cx| {
        let mut armed = false;
        loop {
            match reader.try_take_one() {
                Ok(Some(change)) => {
                    return Poll::Ready(Some(Received {
                        writer: change.writer_guid(),
                        sequence: i64::from(change.sequence_number),
                        related: change.related_sample_identity(),
                        payload: change.into_value().into_bytes(),
                    }));
                }
                Ok(None) if armed => return Poll::Pending,
                // What arrives between a take and the arming would wake nobody, hence another look.
                Ok(None) => {
                    reader.set_waker(Some(cx.waker().clone()));
                    armed = true;
                }
                Err(_) => return Poll::Ready(None),
            }
        }
    })
    .await
}

/// How often endpoints of peers are looked at when nothing waits for them, and when something does.
pub(crate) const IDLE: Duration = Duration::from_millis(200);
pub(crate) const BUSY: Duration = Duration::from_millis(10);
/// How long peers take to learn of our endpoints after we learned of theirs: 30 to 190 ms measured.
const SETTLE: Duration = Duration::from_millis(250);
/// Samples a writer keeps for repairs, and a reader for us.
const DEPTH: i32 = 256;
/// Samples that a reader may leave unacknowledged before the writer stops.
const WINDOW: i32 = 1024;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_and_types_have_the_names_of_ros() {
        let service = Service::new("/arm/grip", &"std_srvs/SetBool".parse().unwrap());
        assert_eq!(service.request_topic(), "rq/arm/gripRequest");
        assert_eq!(service.reply_topic(), "rr/arm/gripReply");
        let types = service.types;
        assert_eq!(types.request, "std_srvs::srv::dds_::SetBool_Request_");
        assert_eq!(types.response, "std_srvs::srv::dds_::SetBool_Response_");
    }
}

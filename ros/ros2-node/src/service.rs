//! Services: a request and a reply, as bytes of any type, with servers and clients of any vendor.
//!
//! A service `/name` consists of two topics, `rq/nameRequest` and `rr/nameReply` (design.ros2.org,
//! "Topic and Service name mapping to DDS"). Requests and replies are CDR with their encapsulation
//! header; [`ServiceMapping`] defines how they are correlated.

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

pub use self::client::{Recall, Replied, ServiceClient, ServiceClientOptions};
pub use self::error::{CallPhase, ServiceError};
pub use self::mapping::ServiceMapping;
pub use self::peers::{ServicePeers, Snapshot, action_type, service_type};
pub use self::server::{ServiceCounters, ServiceOptions, ServiceRequest, ServiceServer};

pub(crate) use self::audience::Audience;
pub(crate) use self::mapping::ReceivedServiceSample;
pub(crate) use self::opening::Opening;
pub(crate) use self::server::{HandlerResult, NoValue};
use crate::domain::Domain;
use crate::raw::PayloadReader;

/// The DDS types of a service's two topics.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceTypes {
    /// The request type, such as `std_srvs::srv::dds_::SetBool_Request_`.
    pub request: String,
    /// The response type, such as `std_srvs::srv::dds_::SetBool_Response_`.
    pub response: String,
}

impl ServiceTypes {
    /// Returns the types of a `.srv` file.
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
pub struct ServiceName {
    /// The ROS name, such as `/arm/grip`.
    pub name: String,
    /// The DDS types of the service.
    pub types: ServiceTypes,
}

impl ServiceName {
    /// Returns the service with the name and the type of a `.srv` file.
    #[must_use]
    pub fn new(name: &str, service_type: &TypeName) -> Self {
        Self {
            name: name.to_owned(),
            types: ServiceTypes::of(service_type),
        }
    }

    /// Sets the type hashes that the domain announces with the next endpoints of the service.
    pub fn announce(&self, domain: &Domain, hashes: &ServiceTypeHashes) {
        domain.learn_type_hash(&self.types.request, hashes.request.to_string());
        domain.learn_type_hash(&self.types.response, hashes.response.to_string());
    }

    /// Returns the DDS topic of the requests.
    #[must_use]
    pub fn request_topic(&self) -> String {
        format!("rq/{}Request", self.name.trim_start_matches('/'))
    }

    /// Returns the DDS topic of the replies.
    #[must_use]
    pub fn reply_topic(&self) -> String {
        format!("rr/{}Reply", self.name.trim_start_matches('/'))
    }
}

/// Returns reliable and volatile policies, the default of rmw for services. Discovery does not
/// compare depths; this depth exceeds the 10 of rmw, so that a burst of calls is kept.
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

/// Receives the next sample, or `None` for an unreadable sample. Cancel-safe: a sample is taken
/// only when it is returned.
pub(crate) async fn next(reader: &PayloadReader) -> Option<ReceivedServiceSample> {
    poll_fn(|cx| {
        let mut armed = false;
        loop {
            match reader.try_take_one() {
                Ok(Some(change)) => {
                    return Poll::Ready(Some(ReceivedServiceSample {
                        writer: change.writer_guid(),
                        sequence: i64::from(change.sequence_number),
                        related: change.related_sample_identity(),
                        payload: change.into_value().into_bytes(),
                    }));
                }
                Ok(None) if armed => return Poll::Pending,
                // A sample that arrives between the take and the arming would wake no task, hence
                // another take.
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

/// Intervals at which the endpoints of peers are polled: while no call waits for them, and while a
/// call waits.
pub(crate) const IDLE: Duration = Duration::from_millis(200);
pub(crate) const BUSY: Duration = Duration::from_millis(10);
/// How long peers take to discover our endpoints after we discovered theirs: 30 to 190 ms measured.
const SETTLE: Duration = Duration::from_millis(250);
/// Samples that a writer keeps for repairs, and a reader for the bridge.
const DEPTH: i32 = 256;
/// Samples that a reader may leave unacknowledged before the writer stops.
const WINDOW: i32 = 1024;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_and_types_have_the_names_of_ros() {
        let service = ServiceName::new("/arm/grip", &"std_srvs/SetBool".parse().unwrap());
        assert_eq!(service.request_topic(), "rq/arm/gripRequest");
        assert_eq!(service.reply_topic(), "rr/arm/gripReply");
        let types = service.types;
        assert_eq!(types.request, "std_srvs::srv::dds_::SetBool_Request_");
        assert_eq!(types.response, "std_srvs::srv::dds_::SetBool_Response_");
    }
}

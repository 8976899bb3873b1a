//! Actions: long-running goals with feedback and cancellation, of any type, with peers of any
//! vendor.
//!
//! An action `/name` consists of three services and two topics below `/name/_action`
//! (design.ros2.org, "Actions"): `send_goal`, `cancel_goal`, `get_result`, `feedback` and `status`.
//! The states of a goal and the response codes follow rcl_action.
//!
//! All messages are CDR with their encapsulation header. Goals and feedback are the messages of the
//! `.action` file, `X_Goal` and `X_Feedback`. Results are sent as `X_GetResult_Response`, which is
//! an Int8 status in front of the fields of `X_Result`. The status byte changes the alignment of
//! the fields, so only a reader that knows the type can split the message.

mod asking;
mod client;
mod client_goals;
mod error;
mod feedback;
mod goal;
mod server;
mod server_goals;
mod server_handles;
mod serving;
mod types;
mod wire;
mod withdrawal;

use messages::{ActionTypeHashes, Dialect, TypeName, TypeRegistry};
use rustdds::policy::{Durability, History, ResourceLimits};
use rustdds::{QosPolicies, QosPolicyBuilder};

pub use self::asking::ActionClientOptions;
pub use self::client::ActionClient;
pub use self::client_goals::{ClientCounters, GoalEvent, Outcome};
pub use self::error::{ActionError, IdInUse, LostReason, NoServer};
pub use self::goal::GoalHandle;
pub use self::server::{ActionServer, ServerEvent};
pub use self::server_goals::{GoalError, ServerCounters};
pub use self::server_handles::{CancelRequest, NewGoal, ServerGoal};
pub use self::serving::ActionServerOptions;
pub use self::types::{CancelAnswer, CancelCode, CancelWhat, GoalId, GoalInfo, GoalStatusCode};

use crate::domain::Domain;
use crate::service::{ServiceName, ServiceTypes};

/// An action by name and type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActionName {
    name: String,
    action_type: TypeName,
}

impl ActionName {
    /// Returns the action with the ROS name, such as `/arm/move`, and the type of an `.action`
    /// file.
    #[must_use]
    pub fn new(name: &str, action_type: &TypeName) -> Self {
        Self {
            name: name.to_owned(),
            action_type: action_type.clone(),
        }
    }

    /// Returns the ROS name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Sets the type hashes that the domain announces with servers and clients opened later.
    pub fn announce(&self, domain: &Domain, hashes: &ActionTypeHashes) {
        self.send_goal().announce(domain, &hashes.send_goal);
        self.get_result().announce(domain, &hashes.get_result);
        domain.learn_type_hash(&self.feedback_type(), hashes.feedback_message.to_string());
    }

    /// Sets the type hashes of the types that all actions share, which are built in.
    fn announce_shared(&self, domain: &Domain) {
        let bundle = TypeRegistry::bundle(Dialect::Ros2);
        let action_msgs = |name| TypeName::new("action_msgs", name);
        if let Ok(hashes) =
            action_msgs("CancelGoal").map(|cancel| bundle.service_type_hashes(&cancel))
            && let Ok(hashes) = hashes
        {
            self.cancel_goal().announce(domain, &hashes);
        }
        if let Ok(hash) = action_msgs("GoalStatusArray").map(|name| bundle.type_hash(&name))
            && let Ok(hash) = hash
        {
            domain.learn_type_hash(STATUS_TYPE, hash.to_string());
        }
    }

    fn send_goal(&self) -> ServiceName {
        self.service("send_goal", self.types("SendGoal"))
    }

    fn get_result(&self) -> ServiceName {
        self.service("get_result", self.types("GetResult"))
    }

    fn cancel_goal(&self) -> ServiceName {
        let of = |half| format!("action_msgs::srv::dds_::CancelGoal_{half}_");
        let types = ServiceTypes {
            request: of("Request"),
            response: of("Response"),
        };
        self.service("cancel_goal", types)
    }

    fn service(&self, part: &str, types: ServiceTypes) -> ServiceName {
        ServiceName {
            name: format!("{}/_action/{part}", self.name),
            types,
        }
    }

    fn types(&self, part: &str) -> ServiceTypes {
        ServiceTypes {
            request: self.dds_type(&format!("{part}_Request")),
            response: self.dds_type(&format!("{part}_Response")),
        }
    }

    fn dds_type(&self, part: &str) -> String {
        let package = self.action_type.package();
        format!(
            "{package}::action::dds_::{}_{part}_",
            self.action_type.name()
        )
    }

    fn feedback_type(&self) -> String {
        self.dds_type("FeedbackMessage")
    }

    fn feedback_topic(&self) -> String {
        self.topic("feedback")
    }

    fn status_topic(&self) -> String {
        self.topic("status")
    }

    fn topic(&self, part: &str) -> String {
        format!("rt/{}/_action/{part}", self.name.trim_start_matches('/'))
    }
}

/// Returns the policies of a status reader (`rcl_action_qos_profile_status_default`): it receives
/// the last status, however late it is created.
fn status_policies() -> QosPolicies {
    QosPolicyBuilder::new()
        .reliable(rustdds::Duration::ZERO)
        .durability(Durability::TransientLocal)
        .history(History::KeepLast {
            depth: STATUS_DEPTH,
        })
        .resource_limits(ResourceLimits {
            max_samples: STATUS_DEPTH,
            max_instances: 1,
            max_samples_per_instance: STATUS_DEPTH,
        })
        .build()
}

const STATUS_TYPE: &str = "action_msgs::msg::dds_::GoalStatusArray_";
/// A status covers all goals, but the statuses in between may cause events.
const STATUS_DEPTH: i32 = 16;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_and_types_have_the_names_of_ros() {
        let action = ActionName::new("/arm/count", &"demo_msgs/Fibonacci".parse().unwrap());
        let send = action.send_goal();
        assert_eq!(
            send.request_topic(),
            "rq/arm/count/_action/send_goalRequest"
        );
        assert_eq!(send.reply_topic(), "rr/arm/count/_action/send_goalReply");
        assert_eq!(
            send.types.request,
            "demo_msgs::action::dds_::Fibonacci_SendGoal_Request_"
        );
        assert_eq!(
            action.get_result().types.response,
            "demo_msgs::action::dds_::Fibonacci_GetResult_Response_"
        );
        assert_eq!(
            action.cancel_goal().types.response,
            "action_msgs::srv::dds_::CancelGoal_Response_"
        );
        assert_eq!(action.feedback_topic(), "rt/arm/count/_action/feedback");
        assert_eq!(
            action.feedback_type(),
            "demo_msgs::action::dds_::Fibonacci_FeedbackMessage_"
        );
        assert_eq!(action.status_topic(), "rt/arm/count/_action/status");
    }
}

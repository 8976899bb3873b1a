//! Services: a request and a response, as bytes of any type.
//!
//! The wire format is TCPROS with the header field `service` (<https://wiki.ros.org/ROS/TCPROS>,
//! "Service"). A request is a UInt32 length and a body. A response is the ok byte, a UInt32 length
//! and a body, little endian. If the ok byte is 0, the body is an error text.

mod client;
mod server;

pub use self::client::{CallPhase, ServiceClient, ServiceClientOptions, ServiceError};
pub(crate) use self::server::{ClientFault, ClientHandshake, OfferedService};
pub use self::server::{ServiceOptions, ServiceRequest, ServiceServer};

/// The type of a service, as its clients compare it and `rosservice` shows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceTypeSum {
    /// Name, such as `std_srvs/SetBool`.
    pub name: String,
    /// Checksum of the definition, request and response together, 32 hexadecimal digits.
    pub md5sum: String,
    /// Name of the request type, such as `std_srvs/SetBoolRequest`.
    pub request_type: String,
    /// Name of the response type, such as `std_srvs/SetBoolResponse`.
    pub response_type: String,
}

/// Default limit of a request or a response: 64 MiB, in bytes.
const DEFAULT_MAX_BODY: usize = 64 * 1024 * 1024;

//! Services: one request, one answer, as bytes of any type.
//!
//! The wire is TCPROS with the header field `service`
//! (<https://wiki.ros.org/ROS/TCPROS>, "Service"): a request is UInt32 length and body, an answer the ok byte, UInt32
//! length and body, little endian. An ok byte of 0 makes the body an error text.

mod client;
mod server;

pub use self::client::{CallPhase, ServiceClient, ServiceClientOptions, ServiceError};
pub(crate) use self::server::{Admitted, ClientFault, Served, nonexistent};
pub use self::server::{ServiceOptions, ServiceRequest, ServiceServer};

/// The type of a service, as its clients compare and `rosservice` shows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceType {
    /// Such as `std_srvs/SetBool`.
    pub name: String,
    /// Checksum of the definition, request and response together, 32 hexadecimal digits.
    pub md5sum: String,
    /// Such as `std_srvs/SetBoolRequest`.
    pub request_type: String,
    /// Such as `std_srvs/SetBoolResponse`.
    pub response_type: String,
}

/// 64 MiB: what one request or answer may have unless the options say otherwise, in bytes.
const DEFAULT_MAX_BODY: usize = 64 * 1024 * 1024;

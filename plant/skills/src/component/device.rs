//! Devices that do the work of skills, implemented by other crates.

use std::fmt::Debug;
use std::sync::Arc;

use async_trait::async_trait;
use tokio::sync::watch;

use super::DriverFault;
use crate::client::{PeerAccess, ToolState};
use crate::driver::Driver;
use crate::parameters::TypeName;
use crate::yaml::{Node, Reader};

/// A device. Its drivers share the connection to it.
#[async_trait]
pub trait Device: Debug + Send + Sync {
    /// Returns the driver of a skill with this type and these supertypes, nearest first. The device
    /// is not connected before a run. `peers` reaches the components that the driver uses.
    ///
    /// # Errors
    /// The device cannot do the work of that type.
    fn driver(
        &self,
        types: &[TypeName],
        peers: &PeerAccess,
    ) -> Result<Arc<dyn Driver>, DriverFault>;

    /// Returns whether its drivers discover other components.
    fn looks_for_others(&self) -> bool {
        false
    }

    /// Returns the state of a tool changer; `None` for other devices.
    fn tool_changer(&self) -> Option<watch::Receiver<ToolState>> {
        None
    }

    /// Keeps the state of the device up to date while its component is served.
    async fn tend(&self, peers: &PeerAccess) {
        let _unused = peers;
        std::future::pending().await
    }
}

/// The kinds of devices that the YAML of a component can contain.
pub trait DeviceKinds {
    /// Reads the value of the key `device`. Returns `None` after an error, which is added to the
    /// findings.
    fn read(&self, node: &Node, reader: &mut Reader<'_>) -> Option<Arc<dyn Device>>;
}

/// Supports no kind of device.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoDevices;

impl DeviceKinds for NoDevices {
    fn read(&self, node: &Node, reader: &mut Reader<'_>) -> Option<Arc<dyn Device>> {
        let message = "this program knows no devices".to_owned();
        reader.refuse(node, crate::yaml::Code::Driver, message)
    }
}

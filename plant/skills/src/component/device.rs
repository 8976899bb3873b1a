//! What a component may be besides simulated: a device, of a kind that another crate brings.

use std::fmt::Debug;
use std::sync::Arc;

use super::DriverFault;
use crate::driver::Driver;
use crate::parameters::TypeName;
use crate::yaml::{Node, Reader};

/// One device: its drivers share the connection to it.
pub trait Device: Debug + Send + Sync {
    /// The driver of a skill whose type and supertypes these are, nearest first. Nothing is connected before a run.
    ///
    /// # Errors
    /// It cannot do the work of that type.
    fn driver(&self, types: &[TypeName]) -> Result<Arc<dyn Driver>, DriverFault>;
}

/// The kinds of devices that the YAML of a component may name.
pub trait DeviceKinds {
    /// Reads what stands under `device`. What is wrong is noted; `None` then.
    fn read(&self, node: &Node, reader: &mut Reader<'_>) -> Option<Arc<dyn Device>>;
}

/// No kind at all.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoDevices;

impl DeviceKinds for NoDevices {
    fn read(&self, node: &Node, reader: &mut Reader<'_>) -> Option<Arc<dyn Device>> {
        let message = "this program knows no devices".to_owned();
        reader.refuse(node, crate::yaml::Code::Driver, message)
    }
}

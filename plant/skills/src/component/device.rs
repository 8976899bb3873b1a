//! Devices that do the work of skills, implemented by other crates.

use std::fmt::Debug;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use tokio::sync::watch;

use super::{DriverFault, SensorRead, SkillSetup};
use crate::client::PeerAccess;
use crate::driver::Driver;
use crate::parameters::ParameterType;
use crate::tool_state::ToolState;
use crate::values::{
    DeviceValue, LiveValue, Measured, ValueFacts, ValueSensor, watch as watch_sensor,
};
use crate::yaml::{DocumentNode, YamlFindingCode, YamlReader};

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
        types: &[ParameterType],
        peers: &PeerAccess,
    ) -> Result<Arc<dyn Driver>, DriverFault>;

    /// Returns the NodeSets with the types of its skills, each with the URI of its namespace.
    fn nodesets(&self) -> Vec<(String, String)> {
        Vec::new()
    }

    /// Returns the skills of a component without `skills` in its description.
    fn skills(&self) -> Vec<SkillSetup> {
        Vec::new()
    }

    /// Returns whether its drivers discover other components.
    fn looks_for_others(&self) -> bool {
        false
    }

    /// Returns the state of a tool changer; `None` for other devices.
    fn tool_changer(&self) -> Option<watch::Receiver<ToolState>> {
        None
    }

    /// Returns the values that the device measures.
    fn values(&self) -> &'static [DeviceValue] {
        &[]
    }

    /// Measures the values of the device until an error occurs, as [`ValueSensor::measure`].
    async fn measure(&self, period: Duration, out: &Measured) -> String {
        let _unused = (period, out);
        std::future::pending().await
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
    /// findings. Paths in the value are relative to `folder`.
    fn read(
        &self,
        node: &DocumentNode,
        folder: &Path,
        reader: &mut YamlReader<'_>,
    ) -> Option<Arc<dyn Device>>;

    /// Reads the driver `http` of a skill. Returns `None` after an error, which is added to the
    /// findings.
    fn http(&self, node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Arc<dyn Driver>> {
        let message = "this program knows no `http`".to_owned();
        reader.refuse(node, YamlFindingCode::Driver, message)
    }

    /// Reads a source of values: the value of the key `kind` of an entry of `values`, which is
    /// `modbus`, `io_link` or `http`. Returns `None` after an error, which is added to the
    /// findings.
    fn sensor(
        &self,
        kind: &str,
        node: &DocumentNode,
        reader: &mut YamlReader<'_>,
    ) -> Option<SensorRead> {
        let message = format!("this program knows no `{kind}`");
        reader.refuse(node, YamlFindingCode::Source, message)
    }
}

/// The values of a device, as a sensor.
#[derive(Debug)]
pub(crate) struct DeviceSensor(pub(crate) Arc<dyn Device>);

#[async_trait]
impl ValueSensor for DeviceSensor {
    async fn measure(&self, period: Duration, out: &Measured) -> String {
        self.0.measure(period, out).await
    }

    fn source(&self) -> String {
        "the device".to_owned()
    }
}

/// Supports no kind of device.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoDevices;

impl DeviceKinds for NoDevices {
    fn read(
        &self,
        node: &DocumentNode,
        _folder: &Path,
        reader: &mut YamlReader<'_>,
    ) -> Option<Arc<dyn Device>> {
        let message = "this program knows no devices".to_owned();
        reader.refuse(node, YamlFindingCode::Driver, message)
    }
}

/// Measures all values of a device as long as the returned future is polled.
pub fn measure_device(
    device: Arc<dyn Device>,
    period: Duration,
) -> (Vec<LiveValue>, impl Future<Output = ()> + Send) {
    let mut measured = Measured::default();
    let live = device.values().iter().map(|value| {
        let facts = ValueFacts {
            name: value.name.to_owned(),
            shape: value.shape,
            unit: value.unit.map(str::to_owned),
            range: value.range,
            about: value.about.to_owned(),
        };
        measured.add(value.name, &Arc::new(facts))
    });
    let live = live.collect();
    (
        live,
        watch_sensor(
            Arc::new(DeviceSensor(device)),
            watch::Sender::new(period).subscribe(),
            measured,
        ),
    )
}

//! Describes a component: its name, its address and its skills.

mod changes;
mod configurable;
mod device;
mod document;
mod drivers;
mod skills;
mod space;
mod texts;
mod values;
mod world;

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use plant_opcua::client::ClientUser;
use plant_opcua::limits::ClientLimits;
use plant_opcua::users::{Roles, UserRole};

pub use changes::{ChangeKind, Takes, YamlChange};
pub(crate) use device::DeviceSensor;
pub use device::{Device, DeviceKinds, NoDevices, measure_device};
pub use document::{read_lds, read_positive, read_security, read_user};
pub use drivers::{DriverFault, Drivers};
pub use skills::read_partner;
pub use space::{Form, RequestKind, SpaceFieldError, SpaceFieldSource, SpaceWork, ValuePart};

pub use texts::{DEFAULT_ENDPOINT, checked_endpoint, read_endpoint, read_name};
pub use values::{ExecSource, MOST_VALUES, SensorRead, TopicSource, ValueSetup, ValueSource};
pub use world::{World, WorldObject, read_numbers, read_shape};

use crate::configuration::Configurable;
use crate::driver::Driver;
use crate::grip::GripPoint;
use crate::parameters::ParameterType;
use crate::workspace::RobotWorkspace;
use crate::yaml::Place;

/// A component, read from YAML or created by a program.
#[derive(Debug, Clone)]
pub struct Component {
    /// The name of the component in the space and in the address space.
    pub name: String,
    /// The ApplicationUri of the server, and the URI of the namespace of its nodes.
    pub application_uri: String,
    /// The number of the component in the space: the WriterGroupId of its values.
    pub namespace: u16,
    /// The URL of the endpoint; port 0 selects a free port.
    pub endpoint: String,
    /// The security policies that clients can choose.
    pub security: Vec<ComponentSecurity>,
    /// NodeSet files with additional types.
    pub nodesets: Vec<PathBuf>,
    /// The discovery server at which the component registers.
    pub lds: Lds,
    /// Whether calls from other hosts are accepted without security.
    pub open: bool,
    /// Idle time after which the lease of a session is released.
    pub lease: Duration,
    /// The user as which its skills use other components; `None` for anonymous.
    pub user: Option<ClientUser>,
    /// The roles of anonymous users; `None` if they are refused.
    pub anonymous: Option<Roles>,
    /// The number of clients that its server serves.
    pub limits: ClientLimits,
    /// The device that does the work of the skills with [`DriverSetup::Device`].
    pub device: Option<Arc<dyn Device>>,
    /// The robot description for clients of OPC 40010-1.
    pub robot: Option<Robot>,
    /// Whether clients may switch the component off (`PowerOffDevice`).
    pub power_off: bool,
    /// The objects of the cell by their ObjectIds, for composites.
    pub world: World,
    /// The positions that its moves reach; `None` for no limits.
    pub workspace: Option<Arc<RobotWorkspace>>,
    /// The values that it shows beside its skills.
    pub values: Vec<ValueSetup>,
    /// The fields of its configuration.
    pub configurable: Vec<Configurable>,
    /// The skills, by their numbers from 1.
    pub skills: Vec<SkillSetup>,
}

/// Data of a robot that OPC 40010-1 requires and that its skills do not contain.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Robot {
    /// The manufacturer.
    pub manufacturer: String,
    /// The model.
    pub model: String,
    /// The ProductCode; empty if unknown.
    pub product_code: String,
    /// The SerialNumber; empty if unknown.
    pub serial_number: String,
    /// A value of MotionDeviceCategoryEnumeration (OPC 40010-1, 7.2.3).
    pub category: i32,
    /// The number of axes that are shown with the value `JointPositions`.
    pub axes: usize,
    /// The location in the document.
    pub place: Place,
}

/// A security policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ComponentSecurity {
    /// No signing and no encryption.
    None,
    /// Signing and encryption.
    Basic256Sha256,
}

/// The discovery server (LDS) at which a component registers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Lds {
    /// The LDS of this host, at its well-known port.
    Local,
    /// No discovery server.
    Nowhere,
    /// The LDS at this URL, or a discovered LDS, as programs select it.
    At(String),
    /// The LDS of this host, at this URL or at its well-known port. If there is none, the component
    /// serves as LDS itself.
    Embed(Option<String>),
}

impl Lds {
    /// Parses the option `--lds` of programs.
    #[must_use]
    pub fn written(text: &str) -> Self {
        match (text, text.strip_prefix("embed=")) {
            ("none", _) => Self::Nowhere,
            ("embed", _) => Self::Embed(None),
            (_, Some(url)) => Self::Embed(Some(url.to_owned())),
            _ => Self::At(text.to_owned()),
        }
    }

    /// Returns the option for this setting: `None` for no LDS, and `local` for the LDS at the
    /// well-known port.
    #[must_use]
    pub fn option(&self, local: &str) -> Option<String> {
        match self {
            Self::Nowhere => None,
            Self::Local => Some(local.to_owned()),
            Self::At(url) => Some(url.clone()),
            Self::Embed(None) => Some("embed".to_owned()),
            Self::Embed(Some(url)) => Some(format!("embed={url}")),
        }
    }
}

/// A skill of a component.
#[derive(Debug, Clone)]
pub struct SkillSetup {
    /// The name of the skill in its component.
    pub name: String,
    /// The type of the skill.
    pub skill_type: ParameterType,
    /// The driver that does the work.
    pub driver: DriverSetup,
    /// The IRIs of the capabilities it provides.
    pub capabilities: Vec<String>,
    /// Time limit of a run; `None` for no limit.
    pub timeout: Option<Duration>,
    /// The grip point of a grasp skill.
    pub grip_point: Option<GripPoint>,
    /// The location of the type in the document.
    pub place: Place,
}

/// Selects the driver of a skill.
#[derive(Clone)]
pub enum DriverSetup {
    /// This driver.
    Given(Arc<dyn Driver>),
    /// A simulation that matches the type.
    Simulated(Simulation),
    /// The skills of a robot and a gripper.
    PickAndPlace(Partners),
    /// The device of the component.
    Device,
    /// A call or action of the space, which the program that runs the component sends.
    Space(Box<SpaceWork>),
    /// A program of the user, which the program that runs the component starts.
    Exec(Box<ExecWork>),
}

/// A program of the user that executes a skill.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExecWork {
    /// The program and its arguments.
    pub command: Vec<String>,
    /// The command that stops the machine after the program was killed.
    pub stop: Option<Vec<String>>,
    /// The working directory: the folder of the YAML file.
    pub folder: PathBuf,
    /// Time from Halt until the program is killed.
    pub halt_timeout: Duration,
}

impl fmt::Debug for DriverSetup {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Given(_) => f.write_str("Given"),
            Self::Simulated(simulation) => simulation.fmt(f),
            Self::PickAndPlace(partners) => partners.fmt(f),
            Self::Device => f.write_str("Device"),
            Self::Space(work) => work.fmt(f),
            Self::Exec(work) => work.fmt(f),
        }
    }
}

/// Settings of a simulation; `None` for the default.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Simulation {
    /// Duration of a motion of the gripper or of a tool change.
    pub duration: Option<Duration>,
    /// Whether there is an object to grasp.
    pub object: Option<bool>,
    /// Reach of the robot, m.
    pub reach: Option<f64>,
    /// Factor by which the simulation is faster than real time.
    pub time_scale: Option<f64>,
    /// Height of the tool below which a contact force acts, m.
    pub contact: Option<f64>,
    /// A hole in the surface at that height: x, y and radius, m.
    pub hole: Option<[f64; 3]>,
}

/// The servers of the skills that a composite runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Partners {
    /// The server of the robot; `None` if each run finds it.
    pub robot: Option<Partner>,
    /// The server of the gripper; `None` if each run finds it.
    pub gripper: Option<Partner>,
    /// The pose of the tool plate in the frame of the flange; `None` for the tool plate of the tool
    /// changer of the robot, if there is one.
    pub plate: Option<[f64; 6]>,
    /// The ApplicationUris of robots and grippers that are preferred, the most preferred first.
    pub prefer: Vec<String>,
    /// Time limit of each run.
    pub within: Duration,
}

/// A server of skills that a composite runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Partner {
    /// The server at this endpoint.
    At(String),
    /// The server with this ApplicationUri, found by a [`Detector`](crate::Detector).
    Called(String),
}

impl fmt::Display for Partner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::At(name) | Self::Called(name) => f.write_str(name),
        }
    }
}

impl Component {
    /// Returns whether a skill needs components that have to be discovered.
    #[must_use]
    pub fn looks_for_others(&self) -> bool {
        let has_composite = self.skills.iter().any(|skill| match &skill.driver {
            DriverSetup::PickAndPlace(_) => true,
            DriverSetup::Given(_)
            | DriverSetup::Simulated(_)
            | DriverSetup::Device
            | DriverSetup::Space(_)
            | DriverSetup::Exec(_) => false,
        });
        let device = self.device.as_ref();
        has_composite || device.is_some_and(|device| device.looks_for_others())
    }
}

/// Returns the default roles of anonymous users: they may run skills while they hold the lease.
#[must_use]
pub fn anonymous_by_default() -> Roles {
    Roles::of(&[UserRole::Observer, UserRole::Operator])
}

/// Default idle time after which the lease of a session is released.
pub const LEASE: Duration = Duration::from_secs(60);

/// Maximum number of skills of a component: node identifiers from 1 000 000 on are used otherwise.
pub const MOST_SKILLS: usize = 1_000;

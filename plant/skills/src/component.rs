//! A component: what it is called, where it is, and which skills it has.

mod device;
mod document;
mod drivers;
mod space;

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use plant_opcua::limits::ClientLimits;

pub use device::{Device, DeviceKinds, NoDevices};
pub use drivers::{DriverFault, Drivers};
pub use space::{Asked, Form, Part, Source, SpaceWork};

use crate::driver::Driver;
use crate::parameters::TypeName;
use crate::yaml::Place;

/// A component as its YAML says it, or as a program makes it.
#[derive(Debug, Clone)]
pub struct Component {
    /// Its name in the space and in the address space.
    pub name: String,
    /// The ApplicationUri of its server, and the URI of the namespace of its nodes.
    pub application_uri: String,
    /// Its number in the space: the WriterGroupId of its values.
    pub namespace: u16,
    /// Where clients connect; port 0 is any that is free.
    pub endpoint: String,
    /// The security policies clients may choose from.
    pub security: Vec<Security>,
    /// NodeSet files with types beyond ours.
    pub nodesets: Vec<PathBuf>,
    /// Where it registers.
    pub lds: Lds,
    /// Whether calls are taken from other hosts, though nothing secures them.
    pub open: bool,
    /// After this time the lease of a session that has nothing done is free for others.
    pub lease: Duration,
    /// The number of clients that its server serves.
    pub limits: ClientLimits,
    /// What does the work of the skills whose driver is [`DriverSetup::Device`].
    pub device: Option<Arc<dyn Device>>,
    /// The robot that it is to clients of OPC 40010-1.
    pub robot: Option<Robot>,
    /// Its skills, by their numbers from 1.
    pub skills: Vec<SkillSetup>,
}

/// What OPC 40010-1 wants to know of a robot, beside what its skills say.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Robot {
    /// Who makes it.
    pub manufacturer: String,
    /// Which one of those.
    pub model: String,
    /// The ProductCode; empty where it is not told.
    pub product_code: String,
    /// The SerialNumber; empty where it is not told.
    pub serial_number: String,
    /// A value of MotionDeviceCategoryEnumeration (OPC 40010-1, 7.2.3).
    pub category: i32,
    /// Where the document says so.
    pub place: Place,
}

/// A security policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Security {
    /// Nothing is signed or encrypted.
    None,
    /// Both are.
    Basic256Sha256,
}

/// The local discovery server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Lds {
    /// On this host, at the port kept for it.
    Local,
    /// None.
    Nowhere,
    /// At this URL, or as programs choose one that is heard of.
    At(String),
    /// Of this host, at this URL or else at the port kept for it; the component is it itself while there is none.
    Embed(Option<String>),
}

impl Lds {
    /// As the option `--lds` of programs is written.
    #[must_use]
    pub fn written(text: &str) -> Self {
        match (text, text.strip_prefix("embed=")) {
            ("none", _) => Self::Nowhere,
            ("embed", _) => Self::Embed(None),
            (_, Some(url)) => Self::Embed(Some(url.to_owned())),
            _ => Self::At(text.to_owned()),
        }
    }

    /// The same backwards; `None` for none, and `local` for the one at the port kept for it.
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

/// One skill of a component.
#[derive(Debug, Clone)]
pub struct SkillSetup {
    /// What the component calls it.
    pub name: String,
    /// Its type.
    pub skill_type: TypeName,
    /// Who does the work.
    pub driver: DriverSetup,
    /// The IRIs of the capabilities it provides.
    pub capabilities: Vec<String>,
    /// How long a run may take; `None` for as long as it likes.
    pub timeout: Option<Duration>,
    /// Where the document says its type.
    pub place: Place,
}

/// Who does the work of a skill.
#[derive(Clone)]
pub enum DriverSetup {
    /// This one.
    Given(Arc<dyn Driver>),
    /// A simulation of what the type is of.
    Simulated(Simulation),
    /// The skills of a robot and a gripper.
    PickAndPlace(Partners),
    /// The device of the component.
    Device,
    /// A call or action of the space, which the program that has the component asks.
    Space(Box<SpaceWork>),
}

impl fmt::Debug for DriverSetup {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Given(_) => f.write_str("Given"),
            Self::Simulated(simulation) => simulation.fmt(f),
            Self::PickAndPlace(partners) => partners.fmt(f),
            Self::Device => f.write_str("Device"),
            Self::Space(work) => work.fmt(f),
        }
    }
}

/// How a simulation is, where it is not as usual.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Simulation {
    /// How long a gripper takes, or a change of tools.
    pub duration: Option<Duration>,
    /// Whether there is a thing to grasp.
    pub object: Option<bool>,
    /// How far a robot reaches, m.
    pub reach: Option<f64>,
    /// How many times faster than time it works.
    pub time_scale: Option<f64>,
    /// Below which height of a robot's tool something pushes back, m.
    pub contact: Option<f64>,
}

/// The servers whose skills a composite runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Partners {
    /// That of the robot.
    pub robot: Partner,
    /// That of the gripper.
    pub gripper: Partner,
    /// How long each of their runs may take.
    pub within: Duration,
}

/// A server whose skills a composite runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Partner {
    /// The one behind this endpoint.
    At(String),
    /// The one with this ApplicationUri, wherever it is: a [`Detector`](crate::Detector) knows.
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
    /// Whether one of its skills needs others that have to be looked for.
    #[must_use]
    pub fn looks_for_others(&self) -> bool {
        self.skills.iter().any(|skill| match &skill.driver {
            DriverSetup::PickAndPlace(Partners { robot, gripper, .. }) => {
                let is_called = |partner: &Partner| matches!(partner, Partner::Called(_));
                is_called(robot) || is_called(gripper)
            }
            DriverSetup::Given(_)
            | DriverSetup::Simulated(_)
            | DriverSetup::Device
            | DriverSetup::Space(_) => false,
        })
    }
}

/// How long a session has the lease without having anything done, where nothing else is said.
pub const LEASE: Duration = Duration::from_secs(60);

/// Most skills of a component: the identifiers of its nodes from 1 000 000 on are others'.
pub const MOST_SKILLS: usize = 1_000;

//! Skills: OPC UA Programs that robots and tools execute, as server and as client.
//!
//! A [`Skill`] is executed in this process. One task owns it, stores the parameters of the next
//! run, publishes each transition before the work starts, and runs a [`Driver`]. It does not depend
//! on an OPC UA server.

mod actor;
mod authority;
pub mod choosing;
pub mod client;
mod component;
mod composite;
mod configuration;
pub mod conformance;
mod driver;
mod driver_error;
pub mod frame;
mod grip;
pub mod model;
mod parameters;
mod part;
mod refusal;
mod runs;
pub mod server;
mod shown;
pub mod simulated;
mod skill;
mod value;
mod values;
mod variant;
mod workspace;
pub mod yaml;

pub use authority::{Authority, Owner};
pub use client::{
    Chosen, ClientOptions, Detected, Detector, FailedLocator, FoundParameter, FoundSkill,
    FoundType, LocatorError, Mirror, Mirrors, Needs, NotLocated, PartnerError, PeerAccess,
    RemoteState, SkillClient, SkillHandle, SkillStates, StationChanges, ToolState, Unchosen,
    UnfitGrasp, Watchable,
};
pub use component::{
    Asked, Change, ChangeKind, Component, Device, DeviceKinds, DriverFault, DriverSetup, Drivers,
    ExecSource, ExecWork, Form, LEASE, Lds, MOST_SKILLS, MOST_VALUES, NoDevices, Part, Partner,
    Partners, Robot, Security, SensorRead, Simulation, SkillSetup, Source, SpaceWork, Takes,
    TopicSource, ValueSetup, ValueSource, World, WorldObject, anonymous_by_default, measure_device,
    read_numbers, read_partner, read_shape, read_user,
};
pub use composite::{Broken, Job, PickAndPlace, Teller};
pub use configuration::{Configurable, Configuration, Effect, NotConfigured};
pub use driver::{Driver, Results, Stopped, Work};
pub use driver_error::{DriverError, InvalidParameter};
pub use grip::{GripError, GripPoint, GripType, NoShape, PartShape};
pub use model::NAMESPACE;
pub use parameters::{NoTypeName, Parameter, Parameters, TypeName};
pub use part::{PartEnd, run_part};
pub use refusal::{Code, Refusal};
pub use runs::{COMPOSITE_HALT_TIMEOUT, LocalRun, Runs, SkillFault};
pub use shown::{Diagnostic, LastCall, Observer, Outcome, Shown, Told, Transitioned};
pub use skill::{Facts, Skill};
pub use value::{Builtin, Shape, Value};
pub use values::{
    DeviceValue, LiveValue, Measure, Measured, Reading, Sensor, Statistics, Tally, ValueFacts,
};
pub use variant::{from_variant, to_variant};
pub use workspace::{OutOfWorkspace, Workspace, Zone};

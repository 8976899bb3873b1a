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
mod description;
mod driver;
mod driver_error;
pub mod frame;
mod grip;
mod lock;
mod machine;
pub mod model;
mod out_of_workspace;
mod outcomes;
mod panics;
mod parameters;
mod part;
mod partner_error;
mod pending;
mod refusal;
mod runs;
pub mod server;
mod shown;
pub mod simulated;
mod skill;
mod skill_fault;
mod tool_state;
mod value;
mod values;
mod variant;
mod workspace;
pub mod yaml;

pub use authority::{Authority, SkillOwner};
pub use client::{
    AttachedElsewhere, Chosen, ClientOptions, ConfigurationHandle, Detected, Detector,
    FailedLocator, FoundConfiguration, FoundParameter, FoundSkill, FoundType, LocatorError,
    MirroredSkill, Mirrors, Needs, NotLocated, PartnerError, PeerAccess, RemoteState,
    SetFieldsFault, SkillClient, SkillHandle, SkillStates, StartCondition, StationChanges,
    Unchosen, UnfitGrasp, Watchable, plate_between,
};
pub use component::{
    ChangeKind, Component, ComponentSecurity, DEFAULT_ENDPOINT, Device, DeviceKinds, DriverFault,
    DriverSetup, Drivers, ExecSource, ExecWork, Form, LEASE, Lds, MOST_SKILLS, MOST_VALUES,
    NoDevices, Partner, Partners, RequestKind, Robot, SensorRead, Simulation, SkillSetup,
    SpaceFieldError, SpaceFieldSource, SpaceWork, Takes, TopicSource, ValuePart, ValueSetup,
    ValueSource, World, WorldObject, YamlChange, anonymous_by_default, checked_endpoint,
    measure_device, read_endpoint, read_lds, read_name, read_numbers, read_partner, read_positive,
    read_security, read_shape, read_user,
};
pub use composite::{Job, PickAndPlace};
pub use configuration::{
    ComponentConfiguration, Configurable, FieldChange, FieldEffect, FieldError, NotConfigured,
};
pub use description::SkillDescription;
pub use driver::{Driver, RunResults, Work};
pub use driver_error::{Broken, DriverError, InvalidParameter, RetreatFault, Stopped};
pub use grip::{GripError, GripPoint, GripType, NoShape, PartShape};
pub use model::NAMESPACE;
pub use out_of_workspace::OutOfWorkspace;
pub use parameters::{NoTypeName, ParameterType, Parameters, SkillParameter};
pub use part::{JobObserver, PartEnd, run_part};
pub use refusal::{RefusalCode, SkillRefusal};
pub use runs::{COMPOSITE_HALT_TIMEOUT, LocalRun, RunnableSkill};
pub use shown::{
    LastCall, ProgramDiagnostic, RunOutcome, SkillEvent, SkillObserver, SkillSnapshot,
    Transitioned, UNKNOWN_OUTCOME,
};
pub use skill::Skill;
pub use skill_fault::SkillFault;
pub use tool_state::ToolState;
pub use value::{Builtin, SkillValue, ValueError, ValueShape};
pub use values::{
    DeviceValue, LiveValue, Measure, Measured, NewestState, Statistics, Tally, UnknownValue,
    ValueFacts, ValueSensor,
};
pub use variant::{from_variant, to_variant};
pub use workspace::{RobotWorkspace, Zone};

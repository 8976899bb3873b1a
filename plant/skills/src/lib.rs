//! Skills: the types of OPC UA programs that robots and tools run by, served and asked for.
//!
//! A [`Skill`] is executed here: one task owns it, keeps the parameters of a run, shows each transition before the work
//! begins, and has a [`Driver`] do the work. It knows no OPC UA server.

mod actor;
mod authority;
mod driver;
pub mod model;
mod parameters;
mod refusal;
mod shown;
mod skill;
mod value;

pub use authority::{Authority, Owner};
pub use driver::{Driver, Results, Stopped, Work};
pub use model::NAMESPACE;
pub use parameters::{NoTypeName, Parameter, Parameters, TypeName};
pub use refusal::{Code, Refusal};
pub use shown::{Diagnostic, LastCall, Observer, Outcome, Shown, Told, Transitioned};
pub use skill::{Facts, Skill};
pub use value::{Builtin, Shape, Value};

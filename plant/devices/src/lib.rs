//! Devices that do the work of skills, each with a simulator of its protocol.
//!
//! A device is one file: its bytes, its driver, what is told when it does not answer. Below it stands a simulator that speaks
//! the same protocol, so that others can try theirs with it (`ua-component simulate`).
//!
//! Reading order: [`line`](Line) (where a device is), `modbus` (asking one), [`robotiq`], [`schmalz`],
//! [`ur`], [`kelvin`] (which moves a robot).

pub mod kelvin;
mod kinds;
mod line;
mod modbus;
pub mod robotiq;
pub mod schmalz;
mod tty;
pub mod ur;

pub use kinds::Kinds;
pub use line::{Line, NoLine};
pub use modbus::Fault as ModbusFault;
pub use modbus::server::{Faults, Registers, Serving, Table};

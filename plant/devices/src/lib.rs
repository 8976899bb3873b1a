//! Devices that execute skills, each with a simulator of its protocol.
//!
//! The code of a device is a single file with its bytes, its driver, and the errors of a missing
//! answer. A submodule contains a simulator of the same protocol, so that other projects can test
//! their software with it (`ua-component simulate`).
//!
//! Reading order: [`line`](ModbusLine) (the address of a device), `modbus` (the client),
//! [`robotiq`], [`schmalz`], [`ur`], [`kelvin`] (which moves a robot), [`module`] (services of
//! process modules), `sensors` (values without skills).

mod addresses;
#[cfg(test)]
mod contact_tests;
mod http;
mod http_skill;
pub mod kelvin;
mod kinds;
mod line;
mod measuring;
mod modbus;
pub mod module;
pub mod robotiq;
pub mod schmalz;
mod sensors;
mod skill_types;
mod tty;
pub mod ur;

pub use kinds::Kinds;
pub use line::{ModbusLine, NoLine};
pub use modbus::ModbusFault;
pub use modbus::server::{LineFaults, RegisterTable, Registers, ServedDevice};

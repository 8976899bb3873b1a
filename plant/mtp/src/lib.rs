//! Module Type Packages: what a process module can do, as its maker wrote it down (VDI/VDE/NAMUR 2658).
//!
//! [`Module::from_bytes`] reads a manifest as it is handed over, in its container and its encoding.
//! [`Module::read`] makes a typed model of a manifest, the AutomationML file in an MTP: the services of the module, their
//! procedures and parameters, and the OPC UA nodes by which each is asked, commanded and watched. Files of 2018 to 2026 differ
//! in what they call things (`ServiceStrategy`, `ServiceProcedure`, `Service/Procedure`; `CommandEn`, `CommandEnable`,
//! `ControlEnable`), in the version of CAEX (2.15, 3.0) and in how parts refer to each other (by RefID or by ID); the model has
//! one name for each thing. What a file says that does not hold together is a [`Finding`], and the rest of it counts.
//!
//! [`Module::triples`] tells the same as RDF, in the terms of [`vocabulary`].
//!
//! No file is opened here and no server is asked.

mod caex;
mod container;
mod model;
mod rdf;
mod read;
pub mod vocabulary;

pub use caex::ManifestError;
pub use model::{
    Access, Bound, Control, Finding, Identifier, Module, Node, Parameter, Procedure, Role, Service,
    ValueKind,
};
pub use rdf::{Object, Triple, escaped};

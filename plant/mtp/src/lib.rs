//! Module Type Packages: descriptions of process modules by their manufacturers (VDI/VDE/NAMUR
//! 2658).
//!
//! [`Module::from_bytes`] reads a manifest in its container and its encoding. [`Module::read`]
//! creates a typed model of a manifest, the AutomationML file in an MTP: the services of the
//! module, their procedures and parameters, and the OPC UA nodes for requests, commands and
//! monitoring. Files of 2018 to 2026 differ in names (`ServiceStrategy`, `ServiceProcedure`,
//! `Service/Procedure`; `CommandEn`, `CommandEnable`, `ControlEnable`), in the version of CAEX
//! (2.15, 3.0) and in references (by RefID or by ID). The model has a single name for each concept.
//! An inconsistency in a file is a [`MtpFinding`], and the rest of the file is used.
//!
//! [`Module::pictures`] has the pictures for operators, and [`ModulePicture::svg`] draws them.
//!
//! [`connect::proposals`] finds outputs of modules for the inputs of others.
//!
//! [`Module::triples`] returns the same as RDF, in the terms of [`vocabulary`]. [`state`] is the
//! state machine of services, and [`pea::Pea`] simulates the module of a manifest.
//!
//! This crate opens no file and calls no server.

mod caex;
pub mod connect;
mod container;
mod drawing;
mod elements;
mod model;
mod notes;
pub mod pea;
mod picture;
mod product;
mod rdf;
mod rdf_module;
mod rdf_picture;
mod read;
pub mod state;
pub mod vocabulary;

pub use caex::ManifestError;
pub use model::{
    AssemblyVariable, Control, ControlRole, DataAssembly, Edition, Family, ItemAccess,
    ManifestServer, Module, ModuleAlarm, ModuleOutput, MtpFinding, MtpService, NodeIdentifier,
    NodeItem, OpcUaNode, OutputRole, ParameterKind, Procedure, ServiceParameter, ValueBound,
    VariableLink,
};
pub use picture::{ModulePicture, PictureConnection, PictureObject, PicturePort};
pub use product::{ConfiguredComponent, ConfiguredValue, ProductFileFault, product_configuration};
pub use rdf::{Object, Triple, unit_symbol};
pub use rdf_module::state_iri;
pub use uri_text::escaped;

//! Bindings of the registry.

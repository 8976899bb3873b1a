//! Patterns of texts, for the schema.

/// A NodeId, with the index or the URI of its namespace.
pub(super) const EXPANDED_NODE_ID: &str = r"^(ns=[0-9]+;|nsu=[^;]+;)?[isgb]=";

/// A time with its unit.
pub(super) const DURATION: &str = r"^[0-9]+(\.[0-9]+)?(ms|s|min|h)$";

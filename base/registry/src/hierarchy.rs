//! Levels of a plant: the selection of a discovery server, the servers of a level, and the names of
//! locations.
//!
//! Reading order: `choice` (the discovery server to register with), `roster` (the servers of a
//! level, from all sources), `place`.

mod choice;
mod place;
mod roster;

pub use choice::{ChoiceFault, ChosenServer, NamePattern, ServerCandidate, ServerChoice};
pub use place::{PlaceFault, PlantLocation};
pub use roster::{Roster, RosterChange};

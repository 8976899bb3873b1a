//! Levels of a plant: which discovery server is the right one, who is on a level, and what its place is called.
//!
//! Reading order: `choice` (the discovery server to register with), `roster` (who is there, whoever tells of it), `place`.

mod choice;
mod place;
mod roster;

pub use choice::{Candidate, Choice, ChoiceFault, Chosen, Pattern};
pub use place::{Place, PlaceFault};
pub use roster::{Change, Roster};

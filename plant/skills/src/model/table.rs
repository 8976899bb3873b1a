//! What the table of skill types is made of.

use program::Rest;

use crate::value::Shape;

/// A skill type.
#[derive(Debug)]
pub struct SkillType {
    /// Its BrowseName.
    pub name: &'static str,
    /// The numeric identifier of its node; those of its children follow it, within a hundred.
    pub id: u32,
    /// The type of the table it is a subtype of.
    pub base: Option<&'static str>,
    /// Whether only subtypes have instances.
    pub is_abstract: bool,
    /// What its instances do, for people.
    pub about: &'static str,
    /// What a run is told, beside what the supertypes have. A parameter keeps its place: new ones come last.
    pub parameters: &'static [Variable],
    /// What a run says at its end, likewise.
    pub results: &'static [Variable],
    /// The state after a run that did its work.
    pub rests_in: Rest,
}

/// A parameter or result in the table.
#[derive(Debug)]
pub struct Variable {
    /// Its BrowseName.
    pub name: &'static str,
    /// Type and rank.
    pub shape: Shape,
    /// How many elements an array has.
    pub length: Option<u32>,
    /// What counts where nothing is given.
    pub preset: Preset,
    /// The unit.
    pub unit: Option<&'static Unit>,
    /// The lowest and the highest of a number.
    pub range: Option<(f64, f64)>,
    /// What it means, for people.
    pub about: &'static str,
}

/// A default.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Preset {
    /// There is none: it must be given.
    None,
    /// A number.
    Number(f64),
    /// A text.
    Text(&'static str),
    /// A Boolean.
    Flag(bool),
}

/// A unit of UNECE Recommendation 20.
#[derive(Debug, PartialEq, Eq)]
pub struct Unit {
    /// As `m/s`.
    pub symbol: &'static str,
    /// As `metre per second`.
    pub name: &'static str,
    /// The code as a number: its characters, the first one highest (OPC 10000-8, 5.6.4.3).
    pub id: u32,
}

//! The elements of the table of skill types.

use program::Rest;

use crate::value::ValueShape;

/// A skill type.
#[derive(Debug)]
pub struct SkillType {
    /// The BrowseName.
    pub name: &'static str,
    /// The numeric identifier of its node; the identifiers of its children follow, within a
    /// hundred.
    pub id: u32,
    /// The name of its supertype in the table.
    pub base: Option<&'static str>,
    /// Whether the type is abstract.
    pub is_abstract: bool,
    /// Description of the instances, for people.
    pub about: &'static str,
    /// The parameters, beside the supertypes' parameters. The order is stable: new parameters are
    /// appended.
    pub parameters: &'static [TableVariable],
    /// The results, beside the supertypes' results; the order is stable too.
    pub results: &'static [TableVariable],
    /// The state after a successful run.
    pub rests_in: Rest,
}

/// A parameter or result in the table.
#[derive(Debug)]
pub struct TableVariable {
    /// The BrowseName.
    pub name: &'static str,
    /// Type and rank.
    pub shape: ValueShape,
    /// The number of elements of an array.
    pub length: Option<u32>,
    /// The default value.
    pub preset: Preset,
    /// The unit.
    pub unit: Option<&'static TableUnit>,
    /// The lowest and the highest value of a number.
    pub range: Option<(f64, f64)>,
    /// Description for people.
    pub about: &'static str,
}

/// A default value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Preset {
    /// No default: the parameter is mandatory.
    None,
    /// A number.
    Number(f64),
    /// A text.
    Text(&'static str),
    /// A Boolean.
    Flag(bool),
    /// So many zeros: an array that is not given.
    Zeros(u32),
}

/// A unit of UNECE Recommendation 20.
#[derive(Debug, PartialEq, Eq)]
pub struct TableUnit {
    /// The symbol, as `m/s`.
    pub symbol: &'static str,
    /// The name, as `metre per second`.
    pub name: &'static str,
    /// The UNECE code as a number, with the first character in the highest byte (OPC 10000-8,
    /// 5.6.4.3).
    pub id: u32,
}

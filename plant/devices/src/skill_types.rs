//! The skill types that a kind of device does.

use skills::{DriverFault, ParameterType};

/// Returns the fault of a skill of other types. `does` are the types whose work the kind of device
/// does.
pub(crate) fn other_type(kind: &str, does: &str, types: &[ParameterType]) -> DriverFault {
    let own = types.first();
    let own = own.map(ParameterType::to_string).unwrap_or_default();
    DriverFault(format!(
        "`{kind}` does the work of {does}, and this is {own}"
    ))
}

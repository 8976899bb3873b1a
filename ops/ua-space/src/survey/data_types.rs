//! DataTypes of namespace 0 and the builtin types of their values (OPC 10000-3, 5.8.3; OPC 10000-6,
//! 5.1.2).

use uadp::BuiltinType;

/// Returns the builtin type of values of the DataType `i=number`; `None` for abstract DataTypes and
/// for DataTypes that are not in the table. Supertypes of the latter may have a builtin type.
pub(crate) fn builtin(number: u32) -> Option<BuiltinType> {
    BuiltinType::from_id(plant_opcua::nodeset::builtin(number)?)
}

/// The DataType Structure. Its values are ExtensionObjects; a subscriber finds the fields in the
/// server.
pub(crate) const STRUCTURE: u32 = 22;

/// Returns a builtin type and whether the values are arrays; `None` for matrices and values of any
/// rank.
pub(crate) fn ranked(builtin: BuiltinType, rank: i64) -> Option<(BuiltinType, bool)> {
    match rank {
        -1 => Some((builtin, false)),
        // Rank 0 stands for one or more dimensions.
        1 => Some((builtin, true)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_abstract_has_no_builtin_type() {
        assert_eq!(builtin(1), Some(BuiltinType::Boolean));
        assert_eq!(builtin(11), Some(BuiltinType::Double));
        assert_eq!(builtin(290), Some(BuiltinType::Double));
        assert_eq!(builtin(294), Some(BuiltinType::DateTime));
        assert_eq!(builtin(29), Some(BuiltinType::Int32));
        for number in [0, 24, 26, 27, 28, 999_999] {
            assert_eq!(builtin(number), None, "{number}");
        }
        assert_eq!(
            ranked(BuiltinType::Byte, -1),
            Some((BuiltinType::Byte, false))
        );
        assert_eq!(
            ranked(BuiltinType::Byte, 1),
            Some((BuiltinType::Byte, true))
        );
        for rank in [-3, -2, 0, 2] {
            assert_eq!(ranked(BuiltinType::Byte, rank), None);
        }
    }
}

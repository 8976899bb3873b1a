//! Values of the parameter server.

use std::collections::BTreeMap;

use crate::parameters::ParamError;
use crate::xmlrpc::XmlRpcValue;

/// The value of a parameter, or of a whole namespace (`wiki.ros.org/Parameter Server`, "Parameter
/// Types").
#[derive(Clone, Debug, PartialEq)]
pub enum ParamValue {
    /// A boolean.
    Bool(bool),
    /// An integer; XML-RPC has 32 bits for it.
    Int(i32),
    /// A number.
    Double(f64),
    /// Text.
    String(String),
    /// A date as ISO 8601, such as `20261121T23:59:59`, unparsed.
    DateTime(String),
    /// Bytes.
    Binary(Vec<u8>),
    /// Values in order.
    List(Vec<Self>),
    /// A namespace: parameters by name.
    Map(BTreeMap<String, Self>),
}

impl ParamValue {
    /// Returns the value if it is a boolean.
    pub const fn as_bool(&self) -> Option<bool> {
        if let Self::Bool(flag) = self {
            Some(*flag)
        } else {
            None
        }
    }

    /// Returns the value if it is an integer.
    pub const fn as_int(&self) -> Option<i32> {
        if let Self::Int(number) = self {
            Some(*number)
        } else {
            None
        }
    }

    /// Returns the value if it is a number or an integer, as users often omit the `.0`.
    pub fn as_double(&self) -> Option<f64> {
        if let Self::Double(number) = self {
            Some(*number)
        } else {
            self.as_int().map(f64::from)
        }
    }

    /// Returns the value if it is text.
    pub fn as_str(&self) -> Option<&str> {
        if let Self::String(text) = self {
            Some(text)
        } else {
            None
        }
    }

    /// Returns the values of a list.
    pub fn as_list(&self) -> Option<&[Self]> {
        if let Self::List(items) = self {
            Some(items)
        } else {
            None
        }
    }

    /// Returns the parameters of a namespace.
    pub const fn as_map(&self) -> Option<&BTreeMap<String, Self>> {
        if let Self::Map(members) = self {
            Some(members)
        } else {
            None
        }
    }

    /// Converts a value from the wire. Returns `None` for a value that contains `<nil/>`, which is
    /// not a valid parameter.
    pub(crate) fn from_wire(value: XmlRpcValue) -> Option<Self> {
        Some(match value {
            XmlRpcValue::Bool(flag) => Self::Bool(flag),
            XmlRpcValue::Int(number) => Self::Int(number),
            XmlRpcValue::Double(number) => Self::Double(number),
            XmlRpcValue::String(text) => Self::String(text),
            XmlRpcValue::DateTime(text) => Self::DateTime(text),
            XmlRpcValue::Binary(bytes) => Self::Binary(bytes),
            XmlRpcValue::Array(items) => Self::List(
                items
                    .into_iter()
                    .map(Self::from_wire)
                    .collect::<Option<_>>()?,
            ),
            XmlRpcValue::Struct(members) => Self::Map(
                members
                    .into_iter()
                    .map(|(name, member)| Some((name, Self::from_wire(member)?)))
                    .collect::<Option<_>>()?,
            ),
            XmlRpcValue::Nil => return None,
        })
    }

    pub(crate) fn into_wire(self) -> XmlRpcValue {
        match self {
            Self::Bool(flag) => XmlRpcValue::Bool(flag),
            Self::Int(number) => XmlRpcValue::Int(number),
            Self::Double(number) => XmlRpcValue::Double(number),
            Self::String(text) => XmlRpcValue::String(text),
            Self::DateTime(text) => XmlRpcValue::DateTime(text),
            Self::Binary(bytes) => XmlRpcValue::Binary(bytes),
            Self::List(items) => {
                XmlRpcValue::Array(items.into_iter().map(Self::into_wire).collect())
            }
            Self::Map(members) => XmlRpcValue::Struct(
                members
                    .into_iter()
                    .map(|(name, member)| (name, member.into_wire()))
                    .collect(),
            ),
        }
    }
}

impl From<bool> for ParamValue {
    fn from(flag: bool) -> Self {
        Self::Bool(flag)
    }
}

impl From<i32> for ParamValue {
    fn from(number: i32) -> Self {
        Self::Int(number)
    }
}

impl From<f64> for ParamValue {
    fn from(number: f64) -> Self {
        Self::Double(number)
    }
}

impl From<&str> for ParamValue {
    fn from(text: &str) -> Self {
        Self::String(text.to_owned())
    }
}

impl From<String> for ParamValue {
    fn from(text: String) -> Self {
        Self::String(text)
    }
}

impl<T: Into<Self>> From<Vec<T>> for ParamValue {
    fn from(items: Vec<T>) -> Self {
        items.into_iter().collect()
    }
}

impl<T: Into<Self>> FromIterator<T> for ParamValue {
    fn from_iter<I: IntoIterator<Item = T>>(items: I) -> Self {
        Self::List(items.into_iter().map(Into::into).collect())
    }
}

impl From<BTreeMap<String, Self>> for ParamValue {
    fn from(members: BTreeMap<String, Self>) -> Self {
        Self::Map(members)
    }
}

impl<K: Into<String>, V: Into<Self>, const N: usize> From<[(K, V); N]> for ParamValue {
    fn from(members: [(K, V); N]) -> Self {
        let members = members.into_iter();
        Self::Map(members.map(|(name, v)| (name.into(), v.into())).collect())
    }
}

/// Fails with [`ParamError::IntRange`] past 32 bits.
impl TryFrom<i64> for ParamValue {
    type Error = ParamError;

    fn try_from(number: i64) -> Result<Self, ParamError> {
        let small = i32::try_from(number);
        small
            .map(Self::Int)
            .map_err(|_| ParamError::IntRange(number.to_string()))
    }
}

/// Fails with [`ParamError::IntRange`] past 31 bits.
impl TryFrom<u64> for ParamValue {
    type Error = ParamError;

    fn try_from(number: u64) -> Result<Self, ParamError> {
        let small = i32::try_from(number);
        small
            .map(Self::Int)
            .map_err(|_| ParamError::IntRange(number.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn an_integer_past_32_bits_is_refused_and_not_cut() {
        assert_eq!(ParamValue::try_from(-5_i64).unwrap(), ParamValue::Int(-5));
        for refused in [
            ParamValue::try_from(i64::from(i32::MAX) + 1),
            ParamValue::try_from(u64::MAX),
        ] {
            assert!(matches!(refused, Err(ParamError::IntRange(_))));
        }
    }

    #[test]
    fn an_integer_serves_where_a_number_is_wanted_but_not_the_other_way() {
        assert_eq!(ParamValue::from(2).as_double(), Some(2.0));
        assert_eq!(ParamValue::from(2.0).as_int(), None);
    }

    #[test]
    fn what_holds_a_nil_is_no_parameter() {
        let list = XmlRpcValue::Array(vec![XmlRpcValue::Int(1), XmlRpcValue::Nil]);
        assert_eq!(ParamValue::from_wire(list), None);
    }

    fn any_value() -> impl Strategy<Value = ParamValue> {
        let leaf = prop_oneof![
            any::<i32>().prop_map(ParamValue::Int),
            any::<bool>().prop_map(ParamValue::Bool),
            (-1e300..1e300).prop_map(ParamValue::Double),
            ".*".prop_map(ParamValue::String),
            prop::collection::vec(any::<u8>(), 0..9).prop_map(ParamValue::Binary),
        ];
        leaf.prop_recursive(4, 32, 4, |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..4).prop_map(ParamValue::List),
                prop::collection::btree_map("[a-z]{1,4}", inner, 0..4).prop_map(ParamValue::Map),
            ]
        })
    }

    proptest! {
        #[test]
        fn a_value_goes_to_the_master_and_back_unchanged(value in any_value()) {
            prop_assert_eq!(ParamValue::from_wire(value.clone().into_wire()), Some(value));
        }
    }
}

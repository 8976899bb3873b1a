use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use crate::TypeNameError;

/// The rules of a definition text: `time`, `Header` and `byte` differ in meaning between the
/// dialects.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Dialect {
    /// `.msg` files of ROS 1 (genmsg).
    Ros1,
    /// `.msg` files of ROS 2 (rosidl).
    Ros2,
}

/// The name of a message type: package and name.
///
/// `std_msgs/Bool` (ROS 1) and `std_msgs/msg/Bool` (ROS 2) are the same name; it prints as the
/// former. A name is at most 255 bytes of ASCII letters, digits and underscores, each part starting
/// with a letter.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TypeName {
    text: Arc<str>,
    slash: usize,
}

const LONGEST: usize = 255;

impl TypeName {
    /// Creates a name from `package` and `name`, both without slashes.
    pub fn new(package: &str, name: &str) -> Result<Self, TypeNameError> {
        if package.len() + name.len() >= LONGEST || !is_identifier(package) || !is_identifier(name)
        {
            return Err(TypeNameError::new(&format!("{package}/{name}")));
        }
        Ok(Self {
            text: format!("{package}/{name}").into(),
            slash: package.len(),
        })
    }

    /// Returns the whole name, such as `std_msgs/Bool`.
    pub fn as_str(&self) -> &str {
        &self.text
    }

    /// Returns the package, such as `std_msgs` of `std_msgs/Bool`.
    pub fn package(&self) -> &str {
        self.text.get(..self.slash).unwrap_or_default()
    }

    /// Returns the name without the package, such as `Bool` of `std_msgs/Bool`.
    pub fn name(&self) -> &str {
        self.text.get(self.slash + 1..).unwrap_or_default()
    }

    /// Returns the ROS 2 notation, such as `std_msgs/msg/Bool`.
    pub fn ros2(&self) -> String {
        format!("{}/msg/{}", self.package(), self.name())
    }

    /// Returns the DDS type name of ROS 2, such as `std_msgs::msg::dds_::Bool_`.
    pub fn dds(&self) -> String {
        format!("{}::msg::dds_::{}_", self.package(), self.name())
    }

    /// Parses the result of [`TypeName::dds`]. Fails for names of services and actions, which are
    /// not message types.
    pub fn from_dds(text: &str) -> Result<Self, TypeNameError> {
        let parts = text
            .split_once("::msg::dds_::")
            .and_then(|(package, name)| Some((package, name.strip_suffix('_')?)));
        match parts {
            Some((package, name)) => Self::new(package, name).map_err(|_| TypeNameError::new(text)),
            None => Err(TypeNameError::new(text)),
        }
    }

    pub(crate) fn is(&self, package: &str, name: &str) -> bool {
        self.package() == package && self.name() == name
    }
}

impl FromStr for TypeName {
    type Err = TypeNameError;

    fn from_str(text: &str) -> Result<Self, TypeNameError> {
        let mut parts = text.split('/');
        match (parts.next(), parts.next(), parts.next(), parts.next()) {
            (Some(package), Some(name), None, None)
            | (Some(package), Some("msg"), Some(name), None) => {
                Self::new(package, name).map_err(|_| TypeNameError::new(text))
            }
            _ => Err(TypeNameError::new(text)),
        }
    }
}

impl fmt::Display for TypeName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

pub(crate) fn is_identifier(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_alphabetic())
        && text.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_spellings_are_one_name() {
        let name: TypeName = "std_msgs/msg/Bool".parse().unwrap();
        assert_eq!(name, "std_msgs/Bool".parse().unwrap());
        assert_eq!(name.to_string(), "std_msgs/Bool");
        assert_eq!(name.ros2(), "std_msgs/msg/Bool");
        assert_eq!(name.dds(), "std_msgs::msg::dds_::Bool_");
        assert_eq!(TypeName::from_dds(&name.dds()).unwrap(), name);
    }

    #[test]
    fn what_is_no_message_type_name_is_refused() {
        for text in [
            "",
            "Bool",
            "/Bool",
            "std_msgs/",
            "std_msgs/srv/Bool",
            "a/msg/b/c",
            "std msgs/Bool",
            "1a/B",
            "a/B\u{e9}",
        ] {
            assert_eq!(
                text.parse::<TypeName>(),
                Err(TypeNameError::new(text)),
                "{text}"
            );
        }
        assert!(
            format!("{}/B", "a".repeat(300))
                .parse::<TypeName>()
                .is_err()
        );
        for text in [
            "std_msgs/Bool",
            "a::srv::dds_::B_Request_",
            "a::msg::dds_::B",
            "a::b::msg::dds_::C_",
        ] {
            assert!(TypeName::from_dds(text).is_err(), "{text}");
        }
    }
}

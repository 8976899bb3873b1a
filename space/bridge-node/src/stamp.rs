//! Decides which messages get a stamp from the bridge.

use messages::{Leaf, MessageType, Selection};

/// Returns whether a message made of `selection` alone starts with a header with a stamp that no
/// value provides, so that the stamp has to be the time of the graph. A message that crosses as a
/// whole keeps its own stamp.
#[must_use]
pub fn wants_stamp(message_type: &MessageType, selection: Option<&Selection>) -> bool {
    let is_stamp = |leaf: &Leaf| leaf.path == STAMP;
    let Some(stamp) = message_type.leaves().first().filter(|leaf| is_stamp(leaf)) else {
        return false;
    };
    let leaves_it = |path: &String| path != STAMP && !stamp.is_inside(path);
    match selection {
        Some(Selection::Field(path) | Selection::Value { field: path, .. })
        | Some(Selection::Structure(Some(path))) => leaves_it(path),
        Some(Selection::Fields(selected)) => selected.iter().all(|one| leaves_it(&one.field)),
        Some(
            Selection::Whole
            | Selection::Structure(None)
            | Selection::Template { .. }
            | Selection::Bytes,
        )
        | None => false,
    }
}

/// The first field of a message that starts with a header.
const STAMP: &str = "header.stamp";

#[cfg(test)]
mod tests {
    use super::*;
    use messages::{Dialect, TypeRegistry};

    #[test]
    fn a_stamp_is_wanted_where_only_a_part_without_it_is_given() {
        let name = "geometry_msgs/TwistStamped".parse().unwrap();
        let stamped = TypeRegistry::bundle(Dialect::Ros2).get(&name).unwrap();
        let field = |path: &str| wants_stamp(&stamped, Some(&Selection::Field(path.to_owned())));
        assert!(field("twist") && field("twist.linear.x") && field("header.frame_id"));
        let converted = Selection::Value {
            field: "twist.linear.x".to_owned(),
            part: None,
            conversion: messages::Conversion::default(),
        };
        assert!(wants_stamp(&stamped, Some(&converted)));
        assert!(!field("header.stamp") && !field("header"));
        assert!(!wants_stamp(&stamped, Some(&Selection::Whole)) && !wants_stamp(&stamped, None));
        let name = "geometry_msgs/Twist".parse().unwrap();
        let plain = TypeRegistry::bundle(Dialect::Ros2).get(&name).unwrap();
        assert!(!wants_stamp(
            &plain,
            Some(&Selection::Field("linear".to_owned()))
        ));
    }
}

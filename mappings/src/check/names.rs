//! ROS topic names.

use messages::Dialect;

/// Longest absolute topic name of ROS 2 (`rmw_validate_full_topic_name`); ROS 1 has no limit.
const MAX_TOPIC: usize = 247;

/// Returns why a text is not an absolute topic name, or `None` if it is one.
pub(super) fn topic_fault(topic: &str, dialect: Dialect) -> Option<String> {
    let Some(parts) = topic.strip_prefix('/') else {
        return Some("it does not begin with `/`".to_owned());
    };
    if topic.len() > MAX_TOPIC {
        return Some(format!(
            "it has {} characters, but at most {MAX_TOPIC} are allowed",
            topic.len()
        ));
    }
    if let Some(strange) = topic
        .chars()
        .find(|c| !c.is_ascii_alphanumeric() && !"/_".contains(*c))
    {
        return Some(format!(
            "{strange:?} is not a letter, digit, underscore or slash"
        ));
    }
    if parts.split('/').any(str::is_empty) {
        return Some("a part between slashes is empty".to_owned());
    }
    match dialect {
        Dialect::Ros1 if !parts.starts_with(|c: char| c.is_ascii_alphabetic()) => {
            Some("in ROS 1 a name begins with a letter".to_owned())
        }
        Dialect::Ros2 => {
            let digit = parts
                .split('/')
                .find(|part| part.starts_with(|c: char| c.is_ascii_digit()))?;
            Some(format!(
                "in ROS 2 the part `{digit}` must not begin with a digit"
            ))
        }
        Dialect::Ros1 => None,
    }
}

/// Returns the nearest legal name, if the mistake is obvious.
pub(super) fn mended(topic: &str, dialect: Dialect) -> Option<String> {
    let parts: Vec<&str> = topic
        .split('/')
        .map(str::trim)
        .filter(|part| !part.is_empty())
        .collect();
    let mended = format!("/{}", parts.join("/")).replace(['-', ' ', '.', ':'], "_");
    (mended != topic && topic_fault(&mended, dialect).is_none()).then_some(mended)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_ros_has_its_own_rule_for_names() {
        let legal = |topic: &str, dialect| topic_fault(topic, dialect).is_none();
        for topic in ["/a", "/conveyor/running", "/A_1/b2", "/a__b"] {
            assert!(
                legal(topic, Dialect::Ros1) && legal(topic, Dialect::Ros2),
                "{topic}"
            );
        }
        for topic in [
            "", "/", "a", "/a/", "//a", "/a//b", "/a-b", "/a b", "/ä", "~a", "/{x}",
        ] {
            assert!(
                !legal(topic, Dialect::Ros1) && !legal(topic, Dialect::Ros2),
                "{topic}"
            );
        }
        assert!(legal("/a/1b", Dialect::Ros1) && !legal("/a/1b", Dialect::Ros2));
        assert!(!legal("/_a", Dialect::Ros1) && legal("/_a", Dialect::Ros2));
        assert!(legal(&format!("/{}", "a".repeat(246)), Dialect::Ros2));
        assert!(!legal(&format!("/{}", "a".repeat(247)), Dialect::Ros2));
    }

    #[test]
    fn a_plain_slip_is_mended() {
        assert_eq!(
            mended("conveyor/running", Dialect::Ros1).unwrap(),
            "/conveyor/running"
        );
        assert_eq!(
            mended("/niryo-ned//state/", Dialect::Ros2).unwrap(),
            "/niryo_ned/state"
        );
        assert_eq!(mended("/1a", Dialect::Ros2), None);
        assert_eq!(mended("/a", Dialect::Ros2), None);
        assert_eq!(mended("", Dialect::Ros2), None);
    }
}

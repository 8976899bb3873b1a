//! The skill messages that both nodes read: `ua_msgs/SkillState` and `ua_msgs/SkillResult`, and
//! `std_srvs/Trigger`.

use serde::{Deserialize, Serialize};

/// `ua_msgs/SkillState`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct SkillState {
    pub(crate) state: String,
    pub(crate) number: u8,
    pub(crate) last_transition: String,
    pub(crate) progress: f32,
    pub(crate) step: String,
    pub(crate) run: u32,
}

/// `ua_msgs/SkillResult`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct SkillResult {
    pub(crate) run: u32,
    pub(crate) succeeded: bool,
    pub(crate) message: String,
    pub(crate) names: Vec<String>,
    pub(crate) values: Vec<String>,
}

impl SkillState {
    pub(crate) const MD5: &'static str = "5db6a3669f9df08bc39eec9478ea8231";

    /// Decodes the body of a ROS 1 message.
    pub(crate) fn from_ros1(body: &[u8]) -> Option<Self> {
        let mut body = Body(body);
        let message = Self {
            state: body.text()?,
            number: body.byte()?,
            last_transition: body.text()?,
            progress: f32::from_le_bytes(body.array()?),
            step: body.text()?,
            run: body.number()?,
        };
        body.ends().then_some(message)
    }
}

impl SkillResult {
    pub(crate) const MD5: &'static str = "bdfa5b931cf5a1c1aa35916cdc13d9d5";

    /// Decodes the body of a ROS 1 message.
    pub(crate) fn from_ros1(body: &[u8]) -> Option<Self> {
        let mut body = Body(body);
        let message = Self {
            run: body.number()?,
            succeeded: body.byte()? != 0,
            message: body.text()?,
            names: body.texts()?,
            values: body.texts()?,
        };
        body.ends().then_some(message)
    }
}

/// Decodes the response of `std_srvs/Trigger` from a ROS 1 body: success and message.
pub(crate) fn trigger_response(body: &[u8]) -> Option<(bool, String)> {
    let mut body = Body(body);
    let response = (body.byte()? != 0, body.text()?);
    body.ends().then_some(response)
}

/// The remaining bytes of a ROS 1 message.
struct Body<'a>(&'a [u8]);

impl Body<'_> {
    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*head)
    }

    fn byte(&mut self) -> Option<u8> {
        self.array().map(|[byte]| byte)
    }

    fn number(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    fn text(&mut self) -> Option<String> {
        let length = usize::try_from(self.number()?).ok()?;
        let (text, rest) = self.0.split_at_checked(length)?;
        self.0 = rest;
        Some(String::from_utf8_lossy(text).into_owned())
    }

    fn texts(&mut self) -> Option<Vec<String>> {
        // Each text takes at least 4 bytes, so decoding stops at the end of the body if the count
        // is too large.
        (0..self.number()?).map(|_| self.text()).collect()
    }

    const fn ends(&self) -> bool {
        self.0.is_empty()
    }
}

/// Type name and MD5 sum of `std_srvs/Trigger`.
pub(crate) const TRIGGER: (&str, &str) = ("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522");

#[cfg(test)]
mod tests {
    use messages::{Dialect, TypeRegistry};

    use super::*;

    #[test]
    fn the_checksums_are_those_of_the_definitions() {
        let registry = TypeRegistry::bundle(Dialect::Ros1);
        for (name, md5) in [
            ("ua_msgs/SkillState", SkillState::MD5),
            ("ua_msgs/SkillResult", SkillResult::MD5),
        ] {
            let known = registry.get(&name.parse().unwrap()).unwrap();
            assert_eq!(known.md5(), md5, "{name}");
        }
        let trigger = registry.service(&TRIGGER.0.parse().unwrap()).unwrap();
        assert_eq!(trigger.md5(), TRIGGER.1);
    }

    #[test]
    fn bodies_are_read_to_their_end_and_not_beyond() {
        let state = b"\x05\0\0\0Ready\x0c\x0d\0\0\0HaltedToReady\0\0\0\x3f\0\0\0\0\x07\0\0\0";
        let read = SkillState::from_ros1(state).unwrap();
        assert_eq!(
            (read.state.as_str(), read.number, read.run),
            ("Ready", 12, 7)
        );
        assert_eq!(
            (read.last_transition.as_str(), read.progress),
            ("HaltedToReady", 0.5)
        );
        let result = b"\x02\0\0\0\x01\0\0\0\0\x01\0\0\0\x07\0\0\0Gripped\x01\0\0\0\x04\0\0\0true";
        let read = SkillResult::from_ros1(result).unwrap();
        assert_eq!((read.run, read.succeeded), (2, true));
        assert_eq!(
            (read.names, read.values),
            (vec!["Gripped".to_owned()], vec!["true".to_owned()])
        );
        for body in [&state[..], result] {
            for end in 0..body.len() {
                assert_eq!(SkillState::from_ros1(&body[..end]), None);
                assert_eq!(SkillResult::from_ros1(&body[..end]), None);
            }
            let longer = [body, &[0]].concat();
            assert_eq!(SkillState::from_ros1(&longer), None);
            assert_eq!(SkillResult::from_ros1(&longer), None);
        }
        assert_eq!(
            trigger_response(b"\x01\x02\0\0\0ok"),
            Some((true, "ok".to_owned()))
        );
        assert_eq!(trigger_response(b"\x01\xff\xff\xff\xff"), None);
    }
}

//! The models of robots (URDF) that viewers show: files, or parameters of a ROS 1 master.
//! Parameters do not cross the space, so a viewer has the model of a ROS 1 robot from here only.

use std::str::FromStr;
use std::time::Duration;

use tcpros::{NodeParameters, ParamValue};
use tokio::time::timeout;
use type_files::read_bounded;

use crate::exit::CommandFailure;

/// The source of a model, as an argument.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ModelSource {
    /// The topic for viewers.
    topic: String,
    origin: Origin,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Origin {
    File(String),
    /// The full name of a parameter, and the URI of its master.
    Parameter {
        master: String,
        name: String,
    },
}

/// A model as a message for viewers.
#[derive(Debug)]
pub(super) struct RobotModelMessage {
    pub(super) topic: String,
    /// A `std_msgs/String` in CDR.
    pub(super) data: Vec<u8>,
}

impl FromStr for ModelSource {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (topic, source) = match text.split_once('=') {
            Some((topic, source)) if is_topic(topic) => (Some(topic), source),
            _ => (None, text),
        };
        if source.is_empty() {
            return Err(FORM);
        }
        let Some(rest) = source.strip_prefix("http://") else {
            return Ok(Self {
                topic: topic.unwrap_or(DESCRIPTION).to_owned(),
                origin: Origin::File(source.to_owned()),
            });
        };
        let (host, name) = match rest.split_once('/') {
            None | Some((_, "")) => (rest.trim_end_matches('/'), DESCRIPTION.to_owned()),
            Some((host, name)) => (host, format!("/{name}")),
        };
        if host.is_empty() || !is_topic(&name) {
            return Err(FORM);
        }
        Ok(Self {
            topic: topic.unwrap_or(&name).to_owned(),
            origin: Origin::Parameter {
                master: format!("http://{host}"),
                name,
            },
        })
    }
}

impl ModelSource {
    /// Reads the model.
    pub(super) async fn load(&self) -> Result<RobotModelMessage, CommandFailure> {
        let (of, text) = match &self.origin {
            Origin::File(file) => (file.clone(), read(file)?),
            Origin::Parameter { master, name } => {
                let of = format!("parameter {name} of {master}");
                (of, parameter(master, name).await?)
            }
        };
        if !text.contains("<robot") {
            return Err(CommandFailure::Data(format!(
                "{of}: no model of a robot: a URDF has an element <robot>\n  = help: xacro files are converted by `xacro FILE`"
            )));
        }
        let topic = self.topic.clone();
        let data = message(&text).ok_or_else(|| {
            CommandFailure::Data(format!("{of}: the model is too long for a message"))
        })?;
        Ok(RobotModelMessage { topic, data })
    }
}

fn read(file: &str) -> Result<String, CommandFailure> {
    let bytes = read_bounded(file.as_ref(), MOST_BYTES)
        .map_err(|why| CommandFailure::Io(format!("cannot read {file}: {why}")))?;
    String::from_utf8(bytes).map_err(|_| CommandFailure::Data(format!("{file}: it is not UTF-8")))
}

async fn parameter(master: &str, name: &str) -> Result<String, CommandFailure> {
    let reading = NodeParameters::of_master(master, CALLER, name);
    let away = |why: String| {
        CommandFailure::Unavailable(format!(
            "cannot read the parameter {name} of the ROS 1 master at {master}: {why}"
        ))
    };
    match timeout(LIMIT, reading).await {
        Ok(Ok(Some(ParamValue::String(text)))) => Ok(text),
        Ok(Ok(Some(_))) => Err(CommandFailure::Data(format!(
            "parameter {name} of {master}: it is no text"
        ))),
        Ok(Ok(None)) => Err(CommandFailure::Unavailable(format!(
            "the ROS 1 master at {master} has no parameter {name}\n  = help: `rosparam list` shows its parameters; the URL may end with the name of another"
        ))),
        Ok(Err(error)) => Err(away(error.to_string())),
        Err(_over) => Err(away(format!("no response within {LIMIT:?}"))),
    }
}

/// Returns a `std_msgs/String` in CDR.
fn message(text: &str) -> Option<Vec<u8>> {
    let length = u32::try_from(text.len()).ok()?.checked_add(1)?;
    let mut data = vec![0, 1, 0, 0];
    data.extend(length.to_le_bytes());
    data.extend(text.as_bytes());
    data.push(0);
    Some(data)
}

/// Returns whether a text is the full name of a ROS topic or parameter.
fn is_topic(text: &str) -> bool {
    let is_part = |part: &str| {
        let mut characters = part.chars();
        let is_first = |first: char| first.is_ascii_alphabetic() || first == '_';
        characters.next().is_some_and(is_first)
            && characters.all(|one| one.is_ascii_alphanumeric() || one == '_')
    };
    text.strip_prefix('/')
        .is_some_and(|rest| rest.split('/').all(is_part))
}

/// The topic on which viewers expect the model of a robot.
const DESCRIPTION: &str = "/robot_description";
/// The type of its messages.
pub(super) const TYPE: &str = "std_msgs/String";
const FORM: &str = "a file (URDF), a ROS 1 master, as http://localhost:11311 or http://localhost:11311/arm/robot_description, or /TOPIC= and one of these";
const CALLER: &str = "/ua_space";
/// A call of 3 s, and the time to resolve the host.
const LIMIT: Duration = Duration::from_secs(8);
const MOST_BYTES: u64 = 16 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    fn source(text: &str) -> Result<(String, Origin), &'static str> {
        let source: ModelSource = text.parse()?;
        Ok((source.topic, source.origin))
    }

    #[test]
    fn a_source_is_a_file_or_a_parameter_with_a_topic() {
        let file = |topic: &str, file: &str| Ok((topic.to_owned(), Origin::File(file.to_owned())));
        let parameter = |topic: &str, name: &str| {
            let master = "http://robot:11311".to_owned();
            let name = name.to_owned();
            Ok((topic.to_owned(), Origin::Parameter { master, name }))
        };
        assert_eq!(source("arm.urdf"), file(DESCRIPTION, "arm.urdf"));
        assert_eq!(source("a=b.urdf"), file(DESCRIPTION, "a=b.urdf"));
        assert_eq!(
            source("/arm/model=arm.urdf"),
            file("/arm/model", "arm.urdf")
        );
        let usual = parameter(DESCRIPTION, DESCRIPTION);
        assert_eq!(source("http://robot:11311"), usual);
        assert_eq!(source("http://robot:11311/"), usual);
        let named = "http://robot:11311/arm/robot_description";
        let name = "/arm/robot_description";
        assert_eq!(source(named), parameter(name, name));
        assert_eq!(source(&format!("/left={named}")), parameter("/left", name));
        for wrong in ["", "/arm=", "http://", "http:///name", "http://robot/a b"] {
            assert!(source(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_model_is_a_string_in_cdr() {
        let data = message("<robot/>").unwrap();
        assert_eq!(data[..8], [0, 1, 0, 0, 9, 0, 0, 0]);
        assert_eq!(&data[8..], b"<robot/>\0");
    }
}

//! Work that a call or an action of the space does: the mapping of parameters to the request and of
//! the response to results.

use std::time::Duration;

use serde_json::Value as Json;

use crate::frame::of_angles;
use crate::parameters::{Parameters, shortened};
use crate::yaml::{DocumentKind, DocumentNode, YamlFindingCode, YamlReader};

/// The work of a skill that another participant of the space does.
#[derive(Debug, Clone, PartialEq)]
pub struct SpaceWork {
    /// The kind of request.
    pub asked: RequestKind,
    /// The name of the call or action in the space, as `ua_2_2_70`.
    pub topic: String,
    /// Time limit for the response of a call, or for the acceptance of a goal.
    pub within: Duration,
    /// Time after Halt during which the end of the work is awaited. After it, a second Halt ends
    /// the run with an unknown outcome.
    pub halt_timeout: Duration,
    /// The sources of the fields of the request or goal, by name. Other fields are set from the
    /// parameters of the same name.
    pub request: Vec<(String, SpaceFieldSource)>,
    /// The sources of results, by name. Other results are set from the fields of the response of
    /// the same name.
    pub results: Vec<(String, SpaceFieldSource)>,
    /// Fields of the response and the values that they have on success.
    pub succeeds: Vec<(String, String)>,
}

/// The kind of request that does the work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RequestKind {
    /// A call, which ends with its response.
    Call,
    /// An action. Its goal has a result and can be cancelled.
    Action,
}

/// The source of a field.
#[derive(Debug, Clone, PartialEq)]
pub enum SpaceFieldSource {
    /// A constant value.
    Constant(Json),
    /// A parameter of the run.
    Parameter(ValuePart),
    /// A field of the response.
    Field(ValuePart),
    /// A list, as the elements of an array of messages.
    List(Vec<Self>),
    /// A message, by its fields.
    Message(Vec<(String, Self)>),
}

/// A value or a part of a value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ValuePart {
    /// The name of the parameter or field.
    pub name: String,
    /// The index of an array element, from 0; `None` for the whole value.
    pub at: Option<usize>,
    /// The conversion of the value.
    pub form: Form,
}

/// The conversion of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// No conversion.
    Plain,
    /// The z of the quaternion that turns about the z axis by a heading in rad.
    QuaternionZ,
    /// The w of that quaternion.
    QuaternionW,
    /// An element of the quaternion w, x, y, z of a pose of six numbers.
    Orientation(usize),
}

/// The reason why a field of a message has no value.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SpaceFieldError {
    /// The skill has no such parameter.
    #[error("the skill has no parameter {0}")]
    NoParameter(String),
    /// The response has no such field.
    #[error("the answer has no field {0}")]
    NoField(String),
    /// The array is too short.
    #[error("{name} has no element {at}")]
    NoElement {
        /// The parameter or field.
        name: String,
        /// The index of the element.
        at: usize,
    },
    /// The value is not a number.
    #[error("{0} is no angle")]
    NoAngle(String),
    /// The value is not an array of six numbers.
    #[error("{0} is no pose of six numbers")]
    NoPose(String),
}

impl ValuePart {
    fn of(&self, whole: Json) -> Result<Json, SpaceFieldError> {
        let name = || self.name.clone();
        let value = match self.at {
            None => whole,
            Some(at) => {
                let element = whole.as_array().and_then(|elements| elements.get(at));
                let none = || SpaceFieldError::NoElement { name: name(), at };
                element.cloned().ok_or_else(none)?
            }
        };
        let half = || {
            let angle = value.as_f64();
            angle
                .map(|angle| angle / 2.0)
                .ok_or_else(|| SpaceFieldError::NoAngle(name()))
        };
        match self.form {
            Form::Plain => Ok(value),
            Form::QuaternionZ => Ok(half()?.sin().into()),
            Form::QuaternionW => Ok(half()?.cos().into()),
            Form::Orientation(element) => {
                let numbers = value.as_array().into_iter().flatten();
                let numbers: Option<Vec<f64>> = numbers.map(Json::as_f64).collect();
                let pose: Option<[f64; 6]> = numbers.and_then(|all| all.try_into().ok());
                let [_, _, _, a, b, c] = pose.ok_or_else(|| SpaceFieldError::NoPose(name()))?;
                let quaternion = of_angles([a, b, c]);
                Ok(quaternion.get(element).copied().unwrap_or_default().into())
            }
        }
    }
}

impl SpaceFieldSource {
    /// Returns the value, from the parameters of a run and, after the response, from its fields.
    ///
    /// # Errors
    /// A value is missing or has another type.
    pub fn value(
        &self,
        parameters: &Parameters,
        answer: &dyn Fn(&str) -> Option<Json>,
    ) -> Result<Json, SpaceFieldError> {
        match self {
            Self::Constant(value) => Ok(value.clone()),
            Self::Parameter(part) => match parameters.get(&part.name) {
                Some(value) => part.of(value.to_json()),
                None => Err(SpaceFieldError::NoParameter(part.name.clone())),
            },
            Self::Field(part) => match answer(&part.name) {
                Some(value) => part.of(value),
                None => Err(SpaceFieldError::NoField(part.name.clone())),
            },
            Self::List(sources) => {
                let values = sources.iter().map(|one| one.value(parameters, answer));
                values.collect::<Result<Vec<_>, _>>().map(Json::Array)
            }
            Self::Message(fields) => {
                let fields = fields
                    .iter()
                    .map(|(name, one)| Ok((name.clone(), one.value(parameters, answer)?)));
                let fields: Result<serde_json::Map<_, _>, SpaceFieldError> = fields.collect();
                fields.map(Json::Object)
            }
        }
    }
}

/// Reads the value of the key `call` or `action`.
pub(super) fn read(
    asked: RequestKind,
    node: &DocumentNode,
    reader: &mut YamlReader<'_>,
) -> Option<SpaceWork> {
    let (topic, [within, halt_timeout, request, results, succeeds]) = match (&node.kind, asked) {
        (DocumentKind::Scalar(_), _) => (Some(node), [None; 5]),
        (_, RequestKind::Call) => {
            let keys = [
                "name",
                "within",
                "halt_timeout",
                "request",
                "results",
                "succeeds",
            ];
            let [topic, rest @ ..] = reader.map(node, keys)?;
            (topic, rest)
        }
        (_, RequestKind::Action) => {
            let keys = [
                "name",
                "within",
                "halt_timeout",
                "goal",
                "results",
                "succeeds",
            ];
            let [topic, rest @ ..] = reader.map(node, keys)?;
            (topic, rest)
        }
    };
    let topic = reader
        .needed(topic, "name", node.place)
        .and_then(|node| read_topic(node, reader));
    let within = within.map_or(Some(USUALLY_WITHIN), |node| reader.duration(node));
    let halt_timeout = halt_timeout.map_or(Some(HALT_TIMEOUT), |node| reader.duration(node));
    let request = entries(request, reader, |node, reader| {
        read_source(node, false, reader)
    });
    let results = entries(results, reader, |node, reader| {
        read_source(node, true, reader)
    });
    let succeeds = entries(succeeds, reader, |node, reader| {
        reader.text(node, "a single value").map(str::to_owned)
    });
    Some(SpaceWork {
        asked,
        topic: topic?,
        within: within?,
        halt_timeout: halt_timeout?,
        request,
        results,
        succeeds,
    })
}

pub(super) fn read_topic(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<String> {
    let text = reader.text(node, "a name of the space")?;
    let number = |text: &str, low: u32, high: u32| {
        let plain = text == "0" || !text.starts_with('0');
        let digits = text.bytes().all(|b| b.is_ascii_digit());
        plain
            && digits
            && text
                .parse()
                .is_ok_and(|number| (low..=high).contains(&number))
    };
    let mut parts = text.split('_');
    let fits = parts.next() == Some("ua")
        && parts.next().is_some_and(|space| number(space, 0, 232))
        && parts
            .next()
            .is_some_and(|namespace| number(namespace, 1, 65_535))
        && parts
            .next()
            .is_some_and(|identifier| number(identifier, 1, 65_535))
        && parts.next().is_none();
    if fits {
        return Some(text.to_owned());
    }
    let message = format!("`{}` is no name of the space", shortened(text));
    let help = "ua_<space>_<namespace>_<identifier>, as ua_2_2_70";
    reader
        .findings()
        .error_with(YamlFindingCode::Driver, node.place, message, help);
    None
}

/// Reads the entries of a map with arbitrary keys.
fn entries<T>(
    node: Option<&DocumentNode>,
    reader: &mut YamlReader<'_>,
    mut read: impl FnMut(&DocumentNode, &mut YamlReader<'_>) -> Option<T>,
) -> Vec<(String, T)> {
    let Some(node) = node else {
        return Vec::new();
    };
    let DocumentKind::Map(pairs) = &node.kind else {
        reader.wrong(node, "a map of fields");
        return Vec::new();
    };
    let mut entries: Vec<(String, T)> = Vec::new();
    for (key, value) in pairs {
        let Some(name) = reader.text(key, "the name of a field").map(str::to_owned) else {
            continue;
        };
        if entries.iter().any(|(known, _)| *known == name) {
            let message = format!("the key `{}` is repeated", shortened(&name));
            reader
                .findings()
                .error(YamlFindingCode::DuplicateKey, key.place, message);
        } else if let Some(value) = read(value, reader) {
            entries.push((name, value));
        }
    }
    entries
}

fn read_source(
    node: &DocumentNode,
    of_answer: bool,
    reader: &mut YamlReader<'_>,
) -> Option<SpaceFieldSource> {
    match &node.kind {
        DocumentKind::Scalar(text) => {
            return Some(SpaceFieldSource::Constant(text.as_str().into()));
        }
        DocumentKind::List(nodes)
            if nodes
                .iter()
                .any(|node| matches!(node.kind, DocumentKind::Map(_))) =>
        {
            // All elements are read, so that all of their faults are found.
            let sources: Vec<Option<SpaceFieldSource>> = nodes
                .iter()
                .map(|node| read_element(node, of_answer, reader))
                .collect();
            return sources
                .into_iter()
                .collect::<Option<_>>()
                .map(SpaceFieldSource::List);
        }
        DocumentKind::List(nodes) => {
            let texts = nodes.iter().map(|node| reader.text(node, "a single value"));
            let texts: Option<Vec<&str>> = texts.collect();
            return Some(SpaceFieldSource::Constant(texts?.into()));
        }
        DocumentKind::Map(_) | DocumentKind::Null => {}
    }
    let [parameter, field, at, form] = reader.map(node, ["parameter", "field", "at", "as"])?;
    let at = match at {
        None => None,
        Some(node) => {
            let text = reader.text(node, "a number")?;
            let Ok(at) = text.parse() else {
                reader.wrong(node, "the number of an element, from 0");
                return None;
            };
            Some(at)
        }
    };
    let form = match form.map(|node| reader.text(node, FORMS)) {
        None => Form::Plain,
        Some(Some("quaternion_z")) => Form::QuaternionZ,
        Some(Some("quaternion_w")) => Form::QuaternionW,
        Some(Some("orientation_w")) => Form::Orientation(0),
        Some(Some("orientation_x")) => Form::Orientation(1),
        Some(Some("orientation_y")) => Form::Orientation(2),
        Some(Some("orientation_z")) => Form::Orientation(3),
        Some(_) => {
            reader.wrong(node, FORMS);
            return None;
        }
    };
    let mut part = |node| {
        let name = reader.text(node, "a name")?.to_owned();
        Some(ValuePart { name, at, form })
    };
    match (parameter, field) {
        (Some(node), None) => part(node).map(SpaceFieldSource::Parameter),
        (None, Some(node)) if of_answer => part(node).map(SpaceFieldSource::Field),
        _ => {
            let wanted = match of_answer {
                true => "a constant, or exactly one of `parameter` and `field`",
                false => "a constant, or a `parameter`",
            };
            reader.wrong(node, wanted);
            None
        }
    }
}

/// Reads an element of a list of messages, or a field of a message: a message, unless it has the
/// keys of a source.
fn read_element(
    node: &DocumentNode,
    of_answer: bool,
    reader: &mut YamlReader<'_>,
) -> Option<SpaceFieldSource> {
    let DocumentKind::Map(pairs) = &node.kind else {
        return read_source(node, of_answer, reader);
    };
    let is_source = pairs.iter().any(|(key, _)| {
        matches!(&key.kind, DocumentKind::Scalar(key) if matches!(key.as_str(), "parameter" | "field"))
    });
    if is_source {
        return read_source(node, of_answer, reader);
    }
    let fields = entries(Some(node), reader, |node, reader| {
        read_element(node, of_answer, reader)
    });
    Some(SpaceFieldSource::Message(fields))
}

/// The values of the key `as`.
const FORMS: &str = "quaternion_z or quaternion_w of a heading, or orientation_x, orientation_y, \
     orientation_z or orientation_w of a pose";
/// Default time limit, the same as for other callers of the space.
const USUALLY_WITHIN: Duration = Duration::from_secs(10);
/// Default `halt_timeout`.
const HALT_TIMEOUT: Duration = Duration::from_secs(10);

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::component::{Component, DriverSetup};

    fn driver(text: &str) -> Result<SpaceWork, String> {
        let document = format!(
            "component: base\napplication_uri: urn:base\nnamespace: 9\nskills:\n  - name: Go\n    \
             type: NavigateToSkillType\n    driver: {text}\n"
        );
        let component = Component::from_yaml(&document, Path::new(""))
            .map_err(|findings| findings.render("base.yaml", &document))?;
        let driver = &component.skills[0].driver;
        let DriverSetup::Space(work) = driver else {
            return Err(format!("{driver:?}"));
        };
        Ok(SpaceWork::clone(work))
    }

    #[test]
    fn a_name_alone_is_a_whole_driver() {
        let work = driver("{call: ua_1_2_61}").unwrap();
        assert_eq!(
            (work.asked, work.topic.as_str()),
            (RequestKind::Call, "ua_1_2_61")
        );
        assert_eq!(
            (work.within, work.halt_timeout),
            (USUALLY_WITHIN, HALT_TIMEOUT)
        );
        assert!(work.request.is_empty() && work.results.is_empty());
    }

    #[test]
    fn fields_are_made_of_constants_parameters_and_parts_of_them() {
        let work = driver(
            "{action: {name: ua_2_2_70, within: 5 s, halt_timeout: 3 s, goal: {tree: '', list: [1, 2], x: {parameter: Goal, at: 0}, \
             z: {parameter: Goal, at: 2, as: quaternion_z}, w: {parameter: Goal, at: 2, as: quaternion_w}}, \
             results: {Pose: {parameter: Goal}, Code: {field: code}}, succeeds: {status: 1}}}",
        )
        .unwrap();
        let goal = (
            "Goal".to_owned(),
            crate::SkillValue::from(vec![1.0, 2.0, 3.0]),
        );
        let declared = crate::model::find("NavigateToSkillType")
            .unwrap()
            .parameters();
        let parameters = Parameters::complete(&declared, vec![goal]).unwrap();
        assert_eq!(work.halt_timeout, Duration::from_secs(3));
        let none = |_: &str| None;
        let of = |name: &str| {
            let (_, source) = work
                .request
                .iter()
                .find(|(known, _)| known == name)
                .unwrap();
            source.value(&parameters, &none).unwrap()
        };
        assert_eq!((of("tree"), of("x")), ("".into(), 1.0.into()));
        assert_eq!(of("list"), serde_json::json!(["1", "2"]));
        let turned = of("z").as_f64().unwrap().atan2(of("w").as_f64().unwrap());
        assert!((turned * 2.0 - 3.0).abs() < 1e-12);
        let [(_, pose), (_, code)] = &work.results[..] else {
            panic!("{:?}", work.results)
        };
        assert_eq!(
            pose.value(&parameters, &none),
            Ok(serde_json::json!([1.0, 2.0, 3.0]))
        );
        assert_eq!(
            code.value(&parameters, &none),
            Err(SpaceFieldError::NoField("code".to_owned()))
        );
        let answer = |name: &str| (name == "code").then(|| 7.into());
        assert_eq!(code.value(&parameters, &answer), Ok(7.into()));
        assert_eq!(work.succeeds, [("status".to_owned(), "1".to_owned())]);
    }

    #[test]
    fn a_list_of_maps_is_an_array_of_messages_with_parts_of_parameters() {
        let work = driver(
            "{action: {name: ua_2_2_70, goal: {constraints: [{link: tip, region: {sizes: [0.1], \
             points: [{x: {parameter: Goal, at: 1}}, {}]}}, {weight: 1}]}}}",
        )
        .unwrap();
        let goal = (
            "Goal".to_owned(),
            crate::SkillValue::from(vec![1.0, 2.0, 3.0]),
        );
        let declared = crate::model::find("NavigateToSkillType")
            .unwrap()
            .parameters();
        let parameters = Parameters::complete(&declared, vec![goal]).unwrap();
        let (name, source) = &work.request[0];
        assert_eq!(name, "constraints");
        assert_eq!(
            source.value(&parameters, &|_| None),
            Ok(serde_json::json!([
                {"link": "tip", "region": {"sizes": ["0.1"], "points": [{"x": 2.0}, {}]}},
                {"weight": "1"}
            ]))
        );
        let wrong = driver("{action: {name: ua_2_2_70, goal: {a: [{x: {parameter: [1]}}]}}}");
        assert!(wrong.is_err(), "{wrong:?}");
    }

    #[test]
    fn an_orientation_is_that_of_a_pose_of_six_numbers() {
        let source = |text: &str| {
            let work = driver(&format!(
                "{{action: {{name: ua_2_2_70, goal: {{x: {{parameter: Goal, as: {text}}}}}}}}}"
            ));
            work.unwrap().request.remove(0).1
        };
        let quarter = std::f64::consts::FRAC_PI_2;
        let pose = serde_json::json!([0.1, 0.2, 0.3, quarter, 0.0, 0.0]);
        for (name, expected) in [
            ("w", 0.5_f64.sqrt()),
            ("x", 0.5_f64.sqrt()),
            ("y", 0.0),
            ("z", 0.0),
        ] {
            let SpaceFieldSource::Parameter(part) = source(&format!("orientation_{name}")) else {
                panic!("{name}")
            };
            let value = part.of(pose.clone()).unwrap().as_f64().unwrap();
            assert!((value - expected).abs() < 1e-12, "{name}: {value}");
        }
        let SpaceFieldSource::Parameter(part) = source("orientation_x") else {
            panic!("no parameter")
        };
        let heading = part.of(serde_json::json!([1.0, 2.0, 3.0])).unwrap_err();
        assert_eq!(heading.to_string(), "Goal is no pose of six numbers");
    }

    #[test]
    fn what_is_wrong_is_told() {
        for (text, expected) in [
            ("{call: conveyor}", "is no name of the space"),
            ("{call: ua_1_02_61}", "is no name of the space"),
            ("{call: ua_1_2_61, simulated: {}}", "exactly one of"),
            ("{action: {goal: {x: 1}}}", "`name` is missing"),
            (
                "{action: {name: ua_2_2_70, goal: {x: {field: y}}}}",
                "a constant, or a `parameter`",
            ),
            (
                "{action: {name: ua_2_2_70, goal: {x: {parameter: Goal, at: first}}}}",
                "from 0",
            ),
            (
                "{action: {name: ua_2_2_70, goal: {x: {parameter: Goal, as: euler}}}}",
                "quaternion_w",
            ),
            (
                "{action: {name: ua_2_2_70, request: {x: 1}}}",
                "unknown key `request`",
            ),
        ] {
            let told = driver(text).unwrap_err();
            assert!(told.contains(expected), "{text}: {told}");
        }
    }
}

//! The values of a component in its YAML.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use super::skills::read_command;
use super::space::read_topic;
use super::texts::read_name;
use super::{Device, DeviceKinds, SkillSetup};
use crate::parameters::shortened;
use crate::value::{Builtin, ValueShape};
use crate::values::{Measure, PERIOD, ValueFacts, ValueSensor};
use crate::yaml::{DocumentKind, DocumentNode, Place, YamlFindingCode, YamlReader, whole};

/// A value of a component.
#[derive(Debug, Clone)]
pub struct ValueSetup {
    /// The description.
    pub facts: Arc<ValueFacts>,
    /// The source.
    pub source: ValueSource,
    /// The period of measurements.
    pub period: Duration,
    /// The location in the document.
    pub place: Place,
}

/// The source of a value.
#[derive(Debug, Clone)]
pub enum ValueSource {
    /// The device of the component, which has the value under this name.
    Device(String),
    /// The runs of a skill; `None` for the runs of all skills.
    Computed(Measure, Option<String>),
    /// A sensor, which may measure several values under their names.
    Sensor(Arc<dyn ValueSensor>),
    /// A topic of the space, which the program that runs the component receives.
    Topic(TopicSource),
    /// A program of the user, which the program that runs the component starts.
    Exec(ExecSource),
}

/// A field of a topic of the space.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicSource {
    /// The name of the topic, as `ua_1_2_5`.
    pub topic: String,
    /// The number of the field, from 0.
    pub field: usize,
}

/// A program of the user that measures values.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExecSource {
    /// The program and its arguments.
    pub command: Vec<String>,
    /// The working directory: the folder of the YAML file.
    pub folder: PathBuf,
    /// The longest time without a line of the program.
    pub within: Duration,
}

/// A sensor that a program supports, read from YAML.
#[derive(Debug)]
pub struct SensorRead {
    /// The sensor.
    pub sensor: Arc<dyn ValueSensor>,
    /// The type of its value, if the YAML does not name it.
    pub shape: ValueShape,
}

/// The surroundings of the values in the document.
pub(super) struct Around<'a> {
    pub(super) folder: &'a Path,
    pub(super) kinds: &'a dyn DeviceKinds,
    pub(super) device: Option<&'a Arc<dyn Device>>,
    /// Whether the device was refused. It may have had skills.
    pub(super) is_refused: bool,
}

/// The surroundings, and the skills of the component.
type Known<'a> = (&'a Around<'a>, &'a [SkillSetup]);

pub(super) fn read_values(
    node: &DocumentNode,
    around: Known<'_>,
    reader: &mut YamlReader<'_>,
) -> Vec<ValueSetup> {
    let mut values: Vec<ValueSetup> = Vec::new();
    for node in reader.list(node) {
        for value in read_entry(node, around, reader) {
            let taken = |known: &ValueSetup| {
                let (known, new) = (&known.facts.name, &value.facts.name);
                known.eq_ignore_ascii_case(new)
            };
            if values.iter().any(taken) {
                let message = format!("there is a value `{}` already", value.facts.name);
                reader
                    .findings()
                    .error(YamlFindingCode::NameTwice, value.place, message);
            }
            values.push(value);
        }
    }
    if values.len() > MOST_VALUES {
        let message = format!(
            "a component has at most {MOST_VALUES} values, and this one {}",
            values.len()
        );
        reader
            .findings()
            .error(YamlFindingCode::TooMany, node.place, message);
    }
    values
}

/// The keys of a value: its description, then its sources.
pub(super) const KEYS: [&str; 16] = [
    "name",
    "about",
    "type",
    "unit",
    "range",
    "period",
    "device",
    "modbus",
    "io_link",
    "http",
    "topic",
    "exec",
    "runs",
    "failures",
    "mean_duration",
    "availability",
];

/// The description of a value as far as the document has it.
struct Described {
    name: Option<String>,
    about: Option<String>,
    shape: Option<ValueShape>,
    unit: Option<String>,
    range: Option<(f64, f64)>,
}

fn read_entry(
    node: &DocumentNode,
    around: Known<'_>,
    reader: &mut YamlReader<'_>,
) -> Vec<ValueSetup> {
    let Some([name, about, of_type, unit, range, period, sources @ ..]) = reader.map(node, KEYS)
    else {
        return Vec::new();
    };
    let place = name.map_or(node.place, |name| name.place);
    let read = [
        name.map(|node| read_name(node, reader)),
        about.map(|node| read_line(node, LONGEST_ABOUT, reader)),
        unit.map(|node| read_line(node, LONGEST_UNIT, reader)),
    ];
    let shape = of_type.map(|node| read_shape_name(node, reader));
    let range = range.map(|node| read_range(node, reader));
    let period = period.map_or(Some(PERIOD), |node| read_period(node, reader));
    let source = read_source(node, sources, around, reader);
    let [name, about, unit] = read.map(whole);
    let (Some(name), Some(about), Some(unit)) = (name, about, unit) else {
        return Vec::new();
    };
    let (Some(shape), Some(range), Some(period), Some(source)) =
        (whole(shape), whole(range), period, source)
    else {
        return Vec::new();
    };
    let described = Described {
        name,
        about,
        shape,
        unit,
        range,
    };
    let values = setups(source, &described, (node, place), reader);
    let values = values.into_iter().map(|(facts, source)| ValueSetup {
        facts: Arc::new(facts),
        source,
        period,
        place,
    });
    let values: Vec<ValueSetup> = values.collect();
    for value in &values {
        check_range(&value.facts, place, reader);
    }
    values
}

/// Returns the descriptions and the sources of the values of an entry.
fn setups(
    source: Source,
    described: &Described,
    (node, place): (&DocumentNode, Place),
    reader: &mut YamlReader<'_>,
) -> Vec<(ValueFacts, ValueSource)> {
    let mut values = Vec::new();
    match source {
        Source::Device(of) => {
            let single = of.len() == 1;
            if !single && described.name.is_some() {
                let message = "`device: all` has several values, and a name is for a single value";
                reader
                    .findings()
                    .error(YamlFindingCode::WrongValue, place, message);
            }
            for value in of {
                let facts = described.facts(value.name, value.shape);
                let facts = ValueFacts {
                    unit: facts.unit.or_else(|| value.unit.map(str::to_owned)),
                    range: facts.range.or(value.range),
                    about: described
                        .about
                        .clone()
                        .unwrap_or_else(|| value.about.to_owned()),
                    ..facts
                };
                values.push((facts, ValueSource::Device(value.name.to_owned())));
            }
        }
        Source::Computed(measure, skill) => {
            let Some(name) = needed_name(described, place, reader) else {
                return values;
            };
            let facts = described.facts(&name, measure.shape());
            let facts = ValueFacts {
                unit: facts.unit.or_else(|| measure.unit().map(str::to_owned)),
                range: facts.range.or_else(|| measure.range()),
                about: described
                    .about
                    .clone()
                    .unwrap_or_else(|| measure.about().to_owned()),
                ..facts
            };
            values.push((facts, ValueSource::Computed(measure, skill)));
        }
        Source::Other(source, shape) => {
            let name = needed_name(described, place, reader);
            let shape = described.shape.or(shape);
            if shape.is_none() {
                let message = "`type` is missing: the source does not define the type of the value";
                reader
                    .findings()
                    .error(YamlFindingCode::MissingKey, node.place, message);
            }
            if let (Some(name), Some(shape)) = (name, shape) {
                values.push((described.facts(&name, shape), source));
            }
        }
    }
    values
}

fn needed_name(described: &Described, at: Place, reader: &mut YamlReader<'_>) -> Option<String> {
    if described.name.is_none() {
        let message = "`name` is missing";
        reader
            .findings()
            .error(YamlFindingCode::MissingKey, at, message);
    }
    described.name.clone()
}

impl Described {
    fn facts(&self, name: &str, shape: ValueShape) -> ValueFacts {
        ValueFacts {
            name: self.name.clone().unwrap_or_else(|| name.to_owned()),
            shape: self.shape.unwrap_or(shape),
            unit: self.unit.clone(),
            range: self.range,
            about: self.about.clone().unwrap_or_default(),
        }
    }
}

/// Units and ranges belong to numbers.
pub(super) fn check_range(facts: &ValueFacts, at: Place, reader: &mut YamlReader<'_>) {
    let is_number = !matches!(facts.shape.builtin, Builtin::Boolean | Builtin::String);
    if !is_number && (facts.range.is_some() || facts.unit.is_some()) {
        let message = format!(
            "`{}` is {}, and only numbers have a unit and a range",
            facts.name, facts.shape
        );
        reader
            .findings()
            .error(YamlFindingCode::WrongValue, at, message);
    }
}

/// A source as it stands in the document.
enum Source {
    Device(Vec<crate::values::DeviceValue>),
    Computed(Measure, Option<String>),
    /// A source and the type of its value, if it defines a type.
    Other(ValueSource, Option<ValueShape>),
}

fn read_source(
    node: &DocumentNode,
    sources: [Option<&DocumentNode>; 10],
    (around, skills): Known<'_>,
    reader: &mut YamlReader<'_>,
) -> Option<Source> {
    let named = KEYS.iter().skip(KEYS.len() - sources.len()).zip(sources);
    let mut given = named.filter_map(|(key, node)| Some((*key, node?)));
    let (Some((key, source)), None) = (given.next(), given.next()) else {
        let all: Vec<&str> = KEYS.iter().skip(6).copied().collect();
        let message = format!("a value has exactly one source of {}", all.join(", "));
        reader
            .findings()
            .error(YamlFindingCode::Source, node.place, message);
        return None;
    };
    match key {
        "device" => read_device(source, around.device, reader).map(Source::Device),
        "topic" => {
            let topic = read_topic_source(source, reader)?;
            Some(Source::Other(ValueSource::Topic(topic), None))
        }
        "exec" => {
            let exec = read_exec_source(source, around.folder, reader)?;
            Some(Source::Other(ValueSource::Exec(exec), None))
        }
        "modbus" | "io_link" | "http" => {
            let read = around.kinds.sensor(key, source, reader)?;
            let sensor = ValueSource::Sensor(read.sensor);
            Some(Source::Other(sensor, Some(read.shape)))
        }
        measure => {
            let (measure, _) = Measure::ALL.into_iter().find(|(_, key)| *key == measure)?;
            let skill = read_skill_name(source, skills, reader)?;
            Some(Source::Computed(measure, skill))
        }
    }
}

/// Reads the name of a skill; `all` for all skills.
fn read_skill_name(
    node: &DocumentNode,
    skills: &[SkillSetup],
    reader: &mut YamlReader<'_>,
) -> Option<Option<String>> {
    let text = reader.text(node, "the name of a skill, or `all`")?;
    if text == "all" {
        return Some(None);
    }
    if skills.iter().any(|skill| skill.name == text) {
        return Some(Some(text.to_owned()));
    }
    let names: Vec<&str> = skills.iter().map(|skill| skill.name.as_str()).collect();
    let message = format!("the component has no skill `{}`", shortened(text));
    let help = match crate::yaml::nearest(text, names.iter().copied()) {
        Some(near) => format!("did you mean `{near}`?"),
        None => format!(
            "its skills are {}; `all` counts all of them",
            names.join(", ")
        ),
    };
    reader
        .findings()
        .error_with(YamlFindingCode::Source, node.place, message, help);
    None
}

fn read_device(
    node: &DocumentNode,
    device: Option<&Arc<dyn Device>>,
    reader: &mut YamlReader<'_>,
) -> Option<Vec<crate::values::DeviceValue>> {
    let text = reader.text(node, "a value of the device, or `all`")?;
    let Some(device) = device else {
        let message = "the component has no `device`".to_owned();
        return reader.refuse(node, YamlFindingCode::Source, message);
    };
    let known = device.values();
    if text == "all" && !known.is_empty() {
        return Some(known.to_vec());
    }
    if let Some(value) = known.iter().find(|value| value.name == text) {
        return Some(vec![*value]);
    }
    let names: Vec<&str> = known.iter().map(|value| value.name).collect();
    let message = format!("the device has no value `{}`", shortened(text));
    let help = match crate::yaml::nearest(text, names.iter().copied()) {
        Some(near) => format!("did you mean `{near}`?"),
        None if names.is_empty() => "this kind of device measures nothing".to_owned(),
        None => format!("its values are {}; `all` has all of them", names.join(", ")),
    };
    reader
        .findings()
        .error_with(YamlFindingCode::Source, node.place, message, help);
    None
}

fn read_topic_source(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<TopicSource> {
    let (topic, field) = match &node.kind {
        DocumentKind::Scalar(_) => (Some(node), None),
        DocumentKind::Null | DocumentKind::List(_) | DocumentKind::Map(_) => {
            let [topic, field] = reader.map(node, ["name", "field"])?;
            (topic, field)
        }
    };
    let topic = reader
        .needed(topic, "name", node.place)
        .and_then(|node| read_topic(node, reader));
    let field = match field {
        None => Some(0),
        Some(node) => {
            let text = reader.text(node, "the number of a field")?;
            text.parse().ok().or_else(|| {
                let found = shortened(text);
                let message = format!("expected the number of a field, from 0, found `{found}`");
                reader.refuse(node, YamlFindingCode::WrongValue, message)
            })
        }
    };
    Some(TopicSource {
        topic: topic?,
        field: field?,
    })
}

fn read_exec_source(
    node: &DocumentNode,
    folder: &Path,
    reader: &mut YamlReader<'_>,
) -> Option<ExecSource> {
    let [command, within] = reader.map(node, ["command", "within"])?;
    let command = reader
        .needed(command, "command", node.place)
        .and_then(|node| read_command(node, reader));
    let within = within.map_or(Some(EXEC_WITHIN), |node| reader.duration(node));
    // The working directory of an empty path would be invalid.
    let folder = match folder.as_os_str().is_empty() {
        true => PathBuf::from("."),
        false => folder.to_owned(),
    };
    Some(ExecSource {
        command: command?,
        folder,
        within: within?,
    })
}

/// Reads a type by its name, as `Double` or `Double[]`.
pub(super) fn read_shape_name(
    node: &DocumentNode,
    reader: &mut YamlReader<'_>,
) -> Option<ValueShape> {
    let text = reader.text(node, "a type, as Double or Double[]")?;
    let (name, array) = match text.strip_suffix("[]") {
        Some(name) => (name, true),
        None => (text, false),
    };
    let known = Builtin::ALL.iter().find(|builtin| builtin.name() == name);
    if let Some(builtin) = known {
        return Some(ValueShape {
            builtin: *builtin,
            array,
        });
    }
    let names: Vec<&str> = Builtin::ALL.iter().map(|builtin| builtin.name()).collect();
    let message = format!("`{}` is no type of a value", shortened(text));
    let help = format!("one of {}; with [] for an array", names.join(", "));
    reader
        .findings()
        .error_with(YamlFindingCode::WrongValue, node.place, message, help);
    None
}

pub(super) fn read_line(
    node: &DocumentNode,
    longest: usize,
    reader: &mut YamlReader<'_>,
) -> Option<String> {
    let text = reader.text(node, "a line of text")?;
    if !text.is_empty() && text.len() <= longest && !text.chars().any(char::is_control) {
        return Some(text.to_owned());
    }
    let found = shortened(text);
    let message = format!("expected a line of at most {longest} bytes, found `{found}`");
    reader.refuse(node, YamlFindingCode::WrongValue, message)
}

pub(super) fn read_range(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<(f64, f64)> {
    let numbers: Vec<f64> = reader
        .list(node)
        .iter()
        .filter_map(|node| reader.number(node, (-1e15, 1e15)))
        .collect();
    match numbers.as_slice() {
        [low, high] if low < high => Some((*low, *high)),
        _ => {
            let message = "a range is the lowest and the highest value: [0, 900]".to_owned();
            reader.refuse(node, YamlFindingCode::WrongValue, message)
        }
    }
}

fn read_period(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Duration> {
    let period = reader.duration(node)?;
    if (SHORTEST_PERIOD..=LONGEST_PERIOD).contains(&period) {
        return Some(period);
    }
    let message = format!("a period is from {SHORTEST_PERIOD:?} to {LONGEST_PERIOD:?}");
    reader.refuse(node, YamlFindingCode::Duration, message)
}

/// Maximum number of values of a component: their identifiers in the space are 11 to 99.
pub const MOST_VALUES: usize = 89;
/// Default time without a line of a program that measures.
const EXEC_WITHIN: Duration = Duration::from_secs(10);
const SHORTEST_PERIOD: Duration = Duration::from_millis(10);
const LONGEST_PERIOD: Duration = Duration::from_secs(3600);
pub(super) const LONGEST_ABOUT: usize = 256;
pub(super) const LONGEST_UNIT: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::component::Component;

    const HEAD: &str = "component: x\napplication_uri: urn:x\nnamespace: 1\n";

    fn read(text: &str) -> Result<Vec<ValueSetup>, String> {
        let document = format!("{HEAD}{text}");
        Component::from_yaml(&document, Path::new("folder"))
            .map(|component| component.values)
            .map_err(|findings| findings.render("x.yaml", &document))
    }

    const SKILLS: &str = "skills:\n  - {name: Grasp, type: GraspSkillType, driver: simulated}\n";

    #[test]
    fn a_component_without_skills_has_the_values_of_its_sensors() {
        let values = read(
            "values:\n  - name: Level\n    type: Double\n    unit: mm\n    range: [0, 500]\n    topic: {name: ua_1_2_5, field: 3}\n  \
             - {name: Heat, type: Float, period: 1 s, exec: {command: [./heat.py], within: 2 s}}\n",
        )
        .unwrap();
        let [level, heat] = values.as_slice() else {
            panic!("{values:?}")
        };
        assert_eq!(
            (level.facts.unit.as_deref(), level.facts.range),
            (Some("mm"), Some((0.0, 500.0)))
        );
        assert!(
            matches!(&level.source, ValueSource::Topic(topic) if topic.topic == "ua_1_2_5" && topic.field == 3)
        );
        assert_eq!(
            (level.period, heat.period),
            (PERIOD, Duration::from_secs(1))
        );
        assert!(
            matches!(&heat.source, ValueSource::Exec(exec) if exec.within == Duration::from_secs(2))
        );
        let told = read("skills: []\n").unwrap_err();
        assert!(told.contains("error[P023]"), "{told}");
        let told = read("").unwrap_err();
        assert!(told.contains("error[P006]: `skills` is missing"), "{told}");
    }

    #[test]
    fn computed_values_have_the_types_and_units_of_their_measures() {
        let values = read(&format!(
            "{SKILLS}values:\n  - {{name: Uptime, availability: all}}\n  - {{name: Runs, runs: Grasp}}\n"
        ))
        .unwrap();
        let facts = &values[0].facts;
        assert_eq!(
            (facts.unit.as_deref(), facts.range),
            (Some("%"), Some((0.0, 100.0)))
        );
        assert_eq!(values[1].facts.shape, ValueShape::scalar(Builtin::UInt32));
        assert!(
            matches!(&values[1].source, ValueSource::Computed(Measure::Runs, Some(skill)) if skill == "Grasp")
        );
    }

    #[test]
    fn wrong_values_are_findings_with_their_lines() {
        for (value, line, expected) in [
            (
                "{name: A, type: Double}",
                6,
                "error[P025]: a value has exactly one source",
            ),
            ("{name: A, runs: Grasp, failures: Grasp}", 6, "error[P025]"),
            ("{name: A, runs: Gras}", 6, "did you mean `Grasp`?"),
            ("{name: A, topic: ua_1_2_5}", 6, "`type` is missing"),
            (
                "{name: A, type: Real, topic: ua_1_2_5}",
                6,
                "one of Boolean, SByte",
            ),
            (
                "{name: A, type: Double, topic: level}",
                6,
                "is no name of the space",
            ),
            (
                "{name: A, type: String, unit: m, topic: ua_1_2_5}",
                6,
                "only numbers",
            ),
            (
                "{name: A, type: Double, range: [2, 1], topic: ua_1_2_5}",
                6,
                "the lowest and the highest",
            ),
            (
                "{name: A, type: Double, period: 1 ms, topic: ua_1_2_5}",
                6,
                "error[P015]",
            ),
            (
                "{name: A, device: Vacuum}",
                6,
                "the component has no `device`",
            ),
            ("{name: A, modbus: {}}", 6, "this program knows no `modbus`"),
            ("{name: A b, runs: all}", 6, "error[P010]"),
            ("{runs: all}", 6, "`name` is missing"),
            ("{name: A, runs: all, units: m}", 6, "did you mean `unit`?"),
            (
                "{name: A, runs: all}\n  - {name: a, runs: all}",
                7,
                "error[P011]",
            ),
        ] {
            let told = read(&format!("{SKILLS}values:\n  - {value}\n")).unwrap_err();
            assert!(told.contains(expected), "{value}: {told}");
            assert!(
                told.contains(&format!("x.yaml:{}:", line + 1)),
                "{value}: {told}"
            );
        }
    }
}

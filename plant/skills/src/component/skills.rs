//! Reads the skills in the YAML of a component, and their drivers.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::texts::{read_endpoint, read_name, read_uri};
use super::world::{read_grip_point, read_numbers};
use super::{
    DeviceKinds, DriverSetup, ExecWork, MOST_SKILLS, Partner, Partners, RequestKind, Simulation,
    SkillSetup,
};
use crate::parameters::ParameterType;
use crate::yaml::{DocumentKind, DocumentNode, Place, YamlFindingCode, YamlReader, whole};

/// Keys of a skill.
pub(super) const SKILL_KEYS: [&str; 6] = [
    "name",
    "type",
    "driver",
    "capabilities",
    "timeout",
    "grip_point",
];

/// The folder of the document, and the kinds of devices.
pub(super) type SkillReading<'a> = (&'a Path, &'a dyn DeviceKinds);

pub(super) fn read_skills(
    node: &DocumentNode,
    around: SkillReading<'_>,
    reader: &mut YamlReader<'_>,
) -> Vec<SkillSetup> {
    let nodes = reader.list(node);
    if nodes.is_empty() || nodes.len() > MOST_SKILLS {
        let message = format!(
            "a component has from 1 to {MOST_SKILLS} skills, and this one {}",
            nodes.len()
        );
        reader
            .findings()
            .error(YamlFindingCode::TooMany, node.place, message);
    }
    let mut skills: Vec<SkillSetup> = Vec::new();
    for node in nodes.iter().take(MOST_SKILLS) {
        let Some((skill, name_at)) = read_skill(node, around, reader) else {
            continue;
        };
        // Names are compared without case, because people do not distinguish them by case.
        if skills
            .iter()
            .any(|known| known.name.eq_ignore_ascii_case(&skill.name))
        {
            let message = format!("there is a skill `{}` already", skill.name);
            reader
                .findings()
                .error(YamlFindingCode::NameTwice, name_at, message);
        }
        skills.push(skill);
    }
    skills
}

fn read_skill(
    node: &DocumentNode,
    around: SkillReading<'_>,
    reader: &mut YamlReader<'_>,
) -> Option<(SkillSetup, Place)> {
    let [name, skill_type, driver, capabilities, timeout, grip_point] =
        reader.map(node, SKILL_KEYS)?;
    let name_at = name.map_or(node.place, |name| name.place);
    let place = skill_type.map_or(node.place, |skill_type| skill_type.place);
    let name = reader
        .needed(name, "name", node.place)
        .and_then(|node| read_name(node, reader));
    let skill_type = reader
        .needed(skill_type, "type", node.place)
        .and_then(|node| read_type(node, reader));
    let driver = reader
        .needed(driver, "driver", node.place)
        .and_then(|node| read_driver(node, around, reader));
    let capabilities = capabilities
        .map(|node| reader.list(node))
        .unwrap_or_default()
        .iter()
        .filter_map(|node| read_uri(node, YamlFindingCode::Capability, reader))
        .collect();
    let timeout = match timeout {
        Some(node) => Some(reader.duration(node)?),
        None => None,
    };
    let grip_point = grip_point.map(|node| read_grip_point(node, reader));
    let skill = SkillSetup {
        name: name?,
        skill_type: skill_type?,
        driver: driver?,
        capabilities,
        timeout,
        grip_point: whole(grip_point)?,
        place,
    };
    Some((skill, name_at))
}

fn read_type(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<ParameterType> {
    let text = reader.text(node, "a skill type")?;
    match text.parse() {
        Ok(name) => Some(name),
        Err(error) => reader.refuse(node, YamlFindingCode::SkillType, error.to_string()),
    }
}

fn read_driver(
    node: &DocumentNode,
    (folder, kinds): SkillReading<'_>,
    reader: &mut YamlReader<'_>,
) -> Option<DriverSetup> {
    if matches!(&node.kind, DocumentKind::Scalar(text) if text == "simulated") {
        return Some(DriverSetup::Simulated(Simulation::default()));
    }
    if matches!(&node.kind, DocumentKind::Scalar(text) if text == "device") {
        return Some(DriverSetup::Device);
    }
    if matches!(&node.kind, DocumentKind::Scalar(text) if text == "pick_and_place") {
        return Some(DriverSetup::PickAndPlace(Partners {
            robot: None,
            gripper: None,
            plate: None,
            prefer: Vec::new(),
            within: USUALLY_WITHIN,
        }));
    }
    let keys = [
        "simulated",
        "pick_and_place",
        "call",
        "action",
        "exec",
        "http",
    ];
    let space = |asked, node, reader: &mut YamlReader<'_>| {
        let work = super::space::read(asked, node, reader);
        work.map(|work| DriverSetup::Space(Box::new(work)))
    };
    match reader.map(node, keys)? {
        [Some(node), None, None, None, None, None] => {
            read_simulation(node, reader).map(DriverSetup::Simulated)
        }
        [None, Some(node), None, None, None, None] => {
            read_partners(node, reader).map(DriverSetup::PickAndPlace)
        }
        [None, None, Some(node), None, None, None] => space(RequestKind::Call, node, reader),
        [None, None, None, Some(node), None, None] => space(RequestKind::Action, node, reader),
        [None, None, None, None, Some(node), None] => {
            read_exec(node, folder, reader).map(|work| DriverSetup::Exec(Box::new(work)))
        }
        [None, None, None, None, None, Some(node)] => {
            kinds.http(node, reader).map(DriverSetup::Given)
        }
        _ => {
            let message = "a driver is exactly one of `simulated`, `device`, `pick_and_place`, `call`, `action`, `exec` and `http`";
            reader
                .findings()
                .error(YamlFindingCode::Driver, node.place, message);
            None
        }
    }
}

fn read_exec(node: &DocumentNode, folder: &Path, reader: &mut YamlReader<'_>) -> Option<ExecWork> {
    let [command, stop, halt_timeout] = reader.map(node, ["command", "stop", "halt_timeout"])?;
    let command = reader
        .needed(command, "command", node.place)
        .and_then(|node| read_command(node, reader));
    let stop = stop.map(|node| read_command(node, reader));
    let halt_timeout = halt_timeout.map_or(Some(USUAL_HALT), |node| reader.duration(node));
    // The working directory of an empty path would be invalid.
    let folder = match folder.as_os_str().is_empty() {
        true => PathBuf::from("."),
        false => folder.to_owned(),
    };
    Some(ExecWork {
        command: command?,
        stop: whole(stop)?,
        folder,
        halt_timeout: halt_timeout?,
    })
}

/// Reads a program and its arguments.
pub(super) fn read_command(
    node: &DocumentNode,
    reader: &mut YamlReader<'_>,
) -> Option<Vec<String>> {
    let nodes = reader.list(node);
    let words: Vec<String> = nodes
        .iter()
        .filter_map(|node| {
            reader
                .text(node, "a program or an argument")
                .map(str::to_owned)
        })
        .collect();
    if words.len() < nodes.len() {
        return None;
    }
    match words.first() {
        Some(program) if !program.is_empty() => Some(words),
        _ => {
            let message = "a command is a list: the program, then its arguments".to_owned();
            reader.refuse(node, YamlFindingCode::WrongValue, message)
        }
    }
}

fn read_simulation(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Simulation> {
    let keys = [
        "duration",
        "object",
        "reach",
        "time_scale",
        "contact",
        "hole",
    ];
    let [duration, object, reach, time_scale, contact, hole] = reader.map(node, keys)?;
    Some(Simulation {
        duration: duration.and_then(|node| reader.duration(node)),
        object: object.and_then(|node| reader.boolean(node)),
        reach: reach.and_then(|node| reader.number(node, (0.01, 100.0))),
        time_scale: time_scale.and_then(|node| reader.number(node, (0.01, 1000.0))),
        contact: contact.and_then(|node| reader.number(node, (-100.0, 100.0))),
        hole: hole.and_then(|node| read_numbers(node, (-100.0, 100.0), reader)),
    })
}

fn read_partners(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Partners> {
    let [robot, gripper, plate, prefer, within] =
        reader.map(node, ["robot", "gripper", "plate", "prefer", "within"])?;
    let prefer = prefer.map(|node| reader.list(node)).unwrap_or_default();
    let prefer: Option<Vec<String>> = prefer
        .iter()
        .map(|node| read_uri(node, YamlFindingCode::Uri, reader))
        .collect();
    let robot = robot.map(|node| read_partner(node, reader));
    let gripper = gripper.map(|node| read_partner(node, reader));
    let plate = plate.map(|node| read_numbers(node, (-10.0, 10.0), reader));
    let within = within.map_or(Some(USUALLY_WITHIN), |node| reader.duration(node));
    Some(Partners {
        robot: whole(robot)?,
        gripper: whole(gripper)?,
        plate: whole(plate)?,
        prefer: prefer?,
        within: within?,
    })
}

/// Reads an endpoint, or the ApplicationUri of a server that is discovered.
pub fn read_partner(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Partner> {
    let is_uri = matches!(&node.kind, DocumentKind::Scalar(text) if text.starts_with("urn:"));
    match is_uri {
        true => read_uri(node, YamlFindingCode::Uri, reader).map(Partner::Called),
        false => read_endpoint(node, reader).map(Partner::At),
    }
}

const USUALLY_WITHIN: Duration = Duration::from_secs(60);
/// Default time from Halt until a program is killed.
const USUAL_HALT: Duration = Duration::from_secs(5);

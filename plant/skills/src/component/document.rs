//! The YAML of a component.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use plant_opcua::client::ClientUser;
use plant_opcua::limits::ClientLimits;
use plant_opcua::users::{Roles, UserRole};

use super::configurable::read_configurable;
use super::skills::read_skills;
use super::texts::{
    DEFAULT_ENDPOINT, LONGEST_NAME, checked_endpoint, read_endpoint, read_name, read_uri,
};
use super::values::{Around, read_values};
use super::world::{read_workspace, read_world};
use super::{
    Component, ComponentSecurity, DeviceKinds, LEASE, Lds, NoDevices, Robot, SkillSetup,
    ValueSetup, anonymous_by_default,
};
use crate::configuration::Configurable;
use crate::parameters::shortened;
use crate::yaml::{DocumentNode, Findings, YamlFindingCode, YamlReader, read_document, whole};

impl Component {
    /// The JSON schema of the YAML.
    pub const SCHEMA: &str = include_str!("component.schema.json");

    /// Reads a component from YAML; paths are relative to `folder`. All errors are reported
    /// together.
    ///
    /// # Errors
    /// The findings in the document. The existence of types is checked later, when their NodeSets
    /// are loaded.
    pub fn from_yaml(text: &str, folder: &Path) -> Result<Self, Findings> {
        Self::from_yaml_with(text, folder, &NoDevices)
    }

    /// Reads a component with devices of these kinds.
    ///
    /// # Errors
    /// As [`from_yaml`](Self::from_yaml).
    pub fn from_yaml_with(
        text: &str,
        folder: &Path,
        kinds: &dyn DeviceKinds,
    ) -> Result<Self, Findings> {
        read_document(text, |root, reader| component(root, folder, kinds, reader))
    }
}

/// Keys of the document.
const KEYS: [&str; 21] = [
    "component",
    "application_uri",
    "namespace",
    "endpoint",
    "security",
    "nodesets",
    "lds",
    "open",
    "lease",
    "user",
    "anonymous",
    "limits",
    "device",
    "robot",
    "world",
    "reach",
    "zones",
    "power_off",
    "values",
    "configurable",
    "skills",
];

fn component(
    root: &DocumentNode,
    folder: &Path,
    kinds: &dyn DeviceKinds,
    reader: &mut YamlReader<'_>,
) -> Option<Component> {
    let [
        name,
        uri,
        namespace,
        endpoint,
        security,
        nodesets,
        lds,
        open,
        lease,
        user,
        anonymous,
        limits,
        device,
        robot,
        world,
        reach,
        zones,
        power_off,
        values,
        configurable,
        skills,
    ] = reader.map(root, KEYS)?;
    // All values are read, so that all errors are reported.
    let name = reader.needed(name, "component", root.place);
    let name = name.and_then(|node| read_name(node, reader));
    let uri = reader.needed(uri, "application_uri", root.place);
    let uri = uri.and_then(|node| read_uri(node, YamlFindingCode::Uri, reader));
    let namespace = reader
        .needed(namespace, "namespace", root.place)
        .and_then(|node| read_positive(node, YamlFindingCode::Namespace, reader));
    let endpoint = match endpoint {
        Some(node) => read_endpoint(node, reader),
        None => Some(DEFAULT_ENDPOINT.to_owned()),
    };
    let security = security.map(|node| read_security(node, reader));
    let nodesets = read_nodesets(nodesets, folder, reader);
    let lds = lds.map_or(Some(Lds::Local), |node| read_lds(node, reader));
    let open = open.map_or(Some(false), |node| reader.boolean(node));
    let lease = lease.map_or(Some(LEASE), |node| reader.duration(node));
    let user = user.map(|node| read_user(node, folder, reader));
    let anonymous = match anonymous {
        Some(node) => read_anonymous(node, reader),
        None => Some(Some(anonymous_by_default())),
    };
    let limits = read_limits(limits, reader);
    let device = device.map(|node| kinds.read(node, folder, reader));
    let robot = robot.map(|node| read_robot(node, reader));
    let power_off = power_off.map_or(Some(false), |node| reader.boolean(node));
    let world = world.map_or_else(BTreeMap::new, |node| read_world(node, reader));
    let workspace = read_workspace([reach, zones], reader);
    let around = Around {
        folder,
        kinds,
        device: device.as_ref().and_then(Option::as_ref),
        is_refused: matches!(device, Some(None)),
    };
    let parts = read_parts(root, [skills, values, configurable], &around, reader);
    Some(Component {
        name: name?,
        application_uri: uri?,
        namespace: namespace?,
        endpoint: endpoint?,
        security: security.unwrap_or_else(|| vec![ComponentSecurity::None]),
        nodesets,
        lds: lds?,
        open: open?,
        lease: lease?,
        user: whole(user)?,
        anonymous: anonymous?,
        limits: limits?,
        device: whole(device)?,
        robot: whole(robot)?,
        power_off: power_off?,
        world: Arc::new(world),
        workspace: workspace?.map(Arc::new),
        values: parts.values,
        configurable: parts.configurable,
        skills: parts.skills?,
    })
}

/// The skills, the values and the configuration of a component.
struct Parts {
    /// `None` after a finding.
    skills: Option<Vec<SkillSetup>>,
    values: Vec<ValueSetup>,
    configurable: Vec<Configurable>,
}

fn read_parts(
    root: &DocumentNode,
    [skills, values, configurable]: [Option<&DocumentNode>; 3],
    around: &Around<'_>,
    reader: &mut YamlReader<'_>,
) -> Parts {
    let of_device = match (around.device, skills) {
        (Some(device), None) => device.skills(),
        _ => Vec::new(),
    };
    let skills = match (skills, values) {
        (None, _) if !of_device.is_empty() || around.is_refused => Some(of_device),
        // A sensor has values and no skills.
        (None, Some(_)) => Some(Vec::new()),
        (skills, _) => reader
            .needed(skills, "skills", root.place)
            .map(|node| read_skills(node, (around.folder, around.kinds), reader)),
    };
    let known = skills.as_deref().unwrap_or_default();
    let values = values.map_or_else(Vec::new, |node| read_values(node, (around, known), reader));
    let configurable = configurable.map_or_else(Vec::new, |node| {
        read_configurable(node, (known, &values), reader)
    });
    Parts {
        skills,
        values,
        configurable,
    }
}

/// Reads the role of anonymous users.
fn read_anonymous(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Option<Roles>> {
    match reader.text(node, "off, observer or operator")? {
        "off" => Some(None),
        "observer" => Some(Some(Roles::of(&[UserRole::Observer]))),
        "operator" => Some(Some(anonymous_by_default())),
        other => {
            let found = shortened(other);
            let message = format!("expected off, observer or operator, found `{found}`");
            reader.refuse(node, YamlFindingCode::WrongValue, message)
        }
    }
}

/// Reads the user as which a component uses other components. The file does not contain the
/// password: it names an environment variable or another file.
pub fn read_user(
    node: &DocumentNode,
    folder: &Path,
    reader: &mut YamlReader<'_>,
) -> Option<ClientUser> {
    let keys = ["name", "password", "password_file"];
    let [name, password, file] = reader.map(node, keys)?;
    let name = reader
        .needed(name, "name", node.place)
        .and_then(|node| reader.text(node, "the name of a user"))
        .map(str::to_owned);
    let password = match (password, file) {
        (Some(node), None) => read_password(node, reader),
        (None, Some(node)) => read_password_file(node, folder, reader),
        (None, None) | (Some(_), Some(_)) => {
            let message = "a user has either `password` or `password_file`".to_owned();
            reader.refuse(node, YamlFindingCode::WrongValue, message)
        }
    };
    Some(ClientUser {
        name: name?,
        password: password?,
    })
}

fn read_password(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<String> {
    let text = reader.text(node, "the name of an environment variable, as ${PASSWORD}")?;
    let variable = text
        .strip_prefix("${")
        .and_then(|rest| rest.strip_suffix('}'));
    let Some(variable) = variable else {
        let message = "the file contains a password in plain text";
        let help = "name an environment variable, as password: \"${PASSWORD}\", or a file, as password_file";
        reader
            .findings()
            .error_with(YamlFindingCode::WrongValue, node.place, message, help);
        return None;
    };
    match std::env::var(variable) {
        Ok(password) if !password.is_empty() => Some(password),
        Ok(_) | Err(_) => {
            let message = format!(
                "the environment variable {} is not set",
                shortened(variable)
            );
            reader.refuse(node, YamlFindingCode::WrongValue, message)
        }
    }
}

fn read_password_file(
    node: &DocumentNode,
    folder: &Path,
    reader: &mut YamlReader<'_>,
) -> Option<String> {
    let path = folder.join(reader.text(node, "the path of a file")?);
    let cannot = |why: &dyn std::fmt::Display| format!("cannot read {}: {why}", path.display());
    let read = std::fs::metadata(&path).and_then(|about| match about.len() {
        0..=LONGEST_PASSWORD_FILE => std::fs::read_to_string(&path),
        _ => Err(std::io::Error::other("the file is too long for a password")),
    });
    let password = match read {
        Ok(text) => text.lines().next().unwrap_or_default().to_owned(),
        Err(error) => return reader.refuse(node, YamlFindingCode::WrongValue, cannot(&error)),
    };
    match password.is_empty() {
        true => reader.refuse(
            node,
            YamlFindingCode::WrongValue,
            cannot(&"its first line is empty"),
        ),
        false => Some(password),
    }
}

fn read_nodesets(
    node: Option<&DocumentNode>,
    folder: &Path,
    reader: &mut YamlReader<'_>,
) -> Vec<PathBuf> {
    let nodes = node.map(|node| reader.list(node)).unwrap_or_default();
    let paths = nodes
        .iter()
        .filter_map(|node| reader.text(node, "the path of a file"));
    paths.map(|path| folder.join(path)).collect()
}

/// The keys of `server.limits` of a mapping that bound clients.
fn read_limits(node: Option<&DocumentNode>, reader: &mut YamlReader<'_>) -> Option<ClientLimits> {
    let Some(node) = node else {
        return Some(ClientLimits::default());
    };
    let keys = [
        "sessions",
        "sessions_per_address",
        "connections",
        "connections_per_address",
    ];
    let mut is_whole = true;
    let given = reader.map(node, keys)?.map(|node| {
        let number = read_positive(node?, YamlFindingCode::WrongValue, reader);
        is_whole &= number.is_some();
        number
    });
    is_whole.then(|| ClientLimits::given(given))
}

fn read_robot(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Robot> {
    let keys = [
        "manufacturer",
        "model",
        "product_code",
        "serial_number",
        "category",
        "axes",
    ];
    let [manufacturer, model, code, number, category, axes] = reader.map(node, keys)?;
    let manufacturer = reader.needed(manufacturer, "manufacturer", node.place);
    let model = reader.needed(model, "model", node.place);
    let mut line = |node: Option<&DocumentNode>| {
        let node = node?;
        let text = reader.text(node, "a line of text")?;
        if text.len() <= LONGEST_NAME && !text.chars().any(char::is_control) {
            return Some(text.to_owned());
        }
        let message = format!(
            "expected a line of at most {LONGEST_NAME} bytes, found `{}`",
            shortened(text)
        );
        reader.refuse(node, YamlFindingCode::WrongValue, message)
    };
    let (manufacturer, model) = (line(manufacturer), line(model));
    let mut line_or_none = |node: Option<&DocumentNode>| match node {
        Some(_) => line(node),
        None => Some(String::new()),
    };
    let (product_code, serial_number) = (line_or_none(code), line_or_none(number));
    let category = category.map_or(Some(0), |node| read_category(node, reader));
    let axes = axes.map_or(Some(USUAL_AXES), |node| read_axes(node, reader));
    Some(Robot {
        manufacturer: manufacturer?,
        model: model?,
        product_code: product_code?,
        serial_number: serial_number?,
        category: category?,
        axes: axes?,
        place: node.place,
    })
}

fn read_axes(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<usize> {
    let text = reader.text(node, "a number of axes")?;
    let axes = text
        .parse::<usize>()
        .ok()
        .filter(|axes| (1..=MOST_AXES).contains(axes));
    axes.or_else(|| {
        let text = shortened(text);
        let message = format!("expected a number from 1 to {MOST_AXES}, found `{text}`");
        reader.refuse(node, YamlFindingCode::WrongValue, message)
    })
}

fn read_category(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<i32> {
    let text = reader.text(node, "the kind of a robot")?;
    let known = (0..).zip(CATEGORIES).find(|(_, name)| *name == text);
    known.map(|(value, _)| value).or_else(|| {
        let message = format!(
            "expected one of {}, found `{}`",
            CATEGORIES.join(", "),
            shortened(text)
        );
        reader.refuse(node, YamlFindingCode::WrongValue, message)
    })
}

/// Reads the discovery server of a component.
pub fn read_lds(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Lds> {
    match Lds::written(reader.text(node, "an endpoint, `embed` or `none`")?) {
        lds @ (Lds::Nowhere | Lds::Local | Lds::Embed(None)) => Some(lds),
        Lds::Embed(Some(url)) => {
            checked_endpoint(&url, node, reader).map(|url| Lds::Embed(Some(url)))
        }
        Lds::At(url) => checked_endpoint(&url, node, reader).map(Lds::At),
    }
}

/// Reads a number from 1 to 65535. Another value is a finding with the code.
pub fn read_positive(
    node: &DocumentNode,
    code: YamlFindingCode,
    reader: &mut YamlReader<'_>,
) -> Option<u16> {
    let text = reader.text(node, "a number")?;
    let number = text.parse().ok().filter(|number| *number > 0);
    number.or_else(|| {
        let message = format!(
            "expected a number from 1 to 65535, found `{}`",
            shortened(text)
        );
        reader.refuse(node, code, message)
    })
}

/// Reads the security policies of a server, at least one.
pub fn read_security(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Vec<ComponentSecurity> {
    let nodes = reader.list(node);
    let policies: Vec<ComponentSecurity> = nodes
        .iter()
        .filter_map(|node| match reader.text(node, "None or Basic256Sha256")? {
            "None" => Some(ComponentSecurity::None),
            "Basic256Sha256" => Some(ComponentSecurity::Basic256Sha256),
            other => {
                let message = format!(
                    "expected None or Basic256Sha256, found `{}`",
                    shortened(other)
                );
                reader.refuse(node, YamlFindingCode::WrongValue, message)
            }
        })
        .collect();
    if nodes.is_empty() {
        let message = "a server without any security policy serves nobody";
        reader
            .findings()
            .error(YamlFindingCode::WrongValue, node.place, message);
    }
    policies
}

const USUAL_AXES: usize = 6;
const MOST_AXES: usize = 32;
const LONGEST_PASSWORD_FILE: u64 = 4096;
/// MotionDeviceCategoryEnumeration (OPC 40010-1, 7.2.3), by its values.
const CATEGORIES: [&str; 7] = [
    "other",
    "articulated_robot",
    "scara_robot",
    "cartesian_robot",
    "spherical_robot",
    "parallel_robot",
    "cylindrical_robot",
];

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::super::DriverSetup;
    use super::super::skills::SKILL_KEYS;
    use super::*;

    const GRIPPER: &str = include_str!("../../../../examples/plant/parallel-gripper.yaml");
    const FAULTS: &str = include_str!("../../tests/faults.yaml");
    const TOLD: &str = include_str!("../../tests/faults.txt");

    #[test]
    fn the_example_is_read_as_it_stands() {
        let component = Component::from_yaml(GRIPPER, Path::new("examples/plant")).unwrap();
        assert_eq!(
            (component.name.as_str(), component.namespace),
            ("parallel-gripper", 7)
        );
        let names: Vec<&str> = component
            .skills
            .iter()
            .map(|skill| skill.name.as_str())
            .collect();
        assert_eq!(names, ["Grasp", "Release"]);
        assert!(
            matches!(&component.skills[0].driver, DriverSetup::Simulated(how) if how.duration == Some(Duration::from_millis(400)))
        );
    }

    #[test]
    fn the_schema_has_the_keys_that_are_read() {
        let schema: serde_json::Value = serde_json::from_str(Component::SCHEMA).unwrap();
        let keys = |of: &serde_json::Value| {
            let mut keys: Vec<String> = of["properties"]
                .as_object()
                .unwrap()
                .keys()
                .cloned()
                .collect();
            keys.sort();
            keys
        };
        let sorted = |keys: &[&str]| {
            let mut keys: Vec<String> = keys.iter().map(|key| (*key).to_owned()).collect();
            keys.sort();
            keys
        };
        assert_eq!(keys(&schema), sorted(&KEYS));
        assert_eq!(keys(&schema["$defs"]["skill"]), sorted(&SKILL_KEYS));
        assert_eq!(
            keys(&schema["$defs"]["value"]),
            sorted(&super::super::values::KEYS)
        );
        assert_eq!(
            keys(&schema["$defs"]["configurable"]),
            sorted(&super::super::configurable::KEYS)
        );
    }

    #[test]
    fn the_limits_of_clients_are_those_of_a_mapping() {
        let read = |limits: &str| {
            let text = format!("{GRIPPER}limits: {limits}\n");
            Component::from_yaml(&text, Path::new("examples/plant"))
                .map(|component| component.limits)
                .map_err(|findings| findings.render("x.yaml", &text))
        };
        let limits = read("{sessions: 8, connections: 20}").unwrap();
        let usual = ClientLimits::of(8);
        assert_eq!((limits.sessions, limits.connections), (8, 20));
        assert_eq!(limits.sessions_per_address, usual.sessions_per_address);
        assert_eq!(
            limits.connections_per_address,
            usual.connections_per_address
        );
        let told = read("{sessions: 0, connection: 5}").unwrap_err();
        for expected in ["from 1 to 65535, found `0`", "`connection`", "connections"] {
            assert!(told.contains(expected), "{expected}: {told}");
        }
    }

    #[test]
    fn the_password_of_a_user_stands_in_a_file_or_in_the_environment() {
        let folder = std::env::temp_dir().join(format!("user-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("secret"), "a b\nrest\n").unwrap();
        let read = |user: &str| {
            let text = format!("{GRIPPER}user: {user}\n");
            Component::from_yaml(&text, &folder)
                .map(|component| component.user.unwrap())
                .map_err(|findings| findings.render("x.yaml", &text))
        };
        let user = read("{name: handling, password_file: secret}").unwrap();
        assert_eq!((&*user.name, &*user.password), ("handling", "a b"));
        let user = read("{name: handling, password: \"${CARGO_MANIFEST_DIR}\"}").unwrap();
        assert_eq!(user.password, env!("CARGO_MANIFEST_DIR"));
        for (user, expected) in [
            ("{name: a}", "either `password` or `password_file`"),
            ("{password: \"${NO_SUCH_VARIABLE}\"}", "`name` is missing"),
            (
                "{name: a, password: \"${NO_SUCH_VARIABLE}\"}",
                "NO_SUCH_VARIABLE is not set",
            ),
            ("{name: a, password: secret}", "in plain text"),
            ("{name: a, password_file: nowhere}", "cannot read"),
        ] {
            let findings = read(user).unwrap_err();
            assert!(findings.contains(expected), "{user}: {findings}");
        }
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn a_robot_is_read_and_all_that_is_wrong_with_it_told() {
        let read = |robot: &str| {
            let text = format!("{GRIPPER}robot: {robot}\n");
            Component::from_yaml(&text, Path::new("examples/plant"))
                .map(|component| component.robot.unwrap())
                .map_err(|findings| findings.render("x.yaml", &text))
        };
        let robot = read("{manufacturer: A, model: B 5, category: scara_robot}").unwrap();
        assert_eq!(
            (robot.manufacturer.as_str(), robot.model.as_str()),
            ("A", "B 5")
        );
        assert_eq!((robot.serial_number.as_str(), robot.category), ("", 2));
        let told = read("{manufacturer: [A], category: humanoid}").unwrap_err();
        for expected in [
            "error[P006]",
            "`model`",
            "error[P005]",
            "a line of text",
            "other, articulated_robot",
        ] {
            assert!(told.contains(expected), "{expected} is not in\n{told}");
        }
        let long = format!("{{manufacturer: A, model: {}}}", "x".repeat(65));
        assert!(read(&long).unwrap_err().contains("at most 64 bytes"));
    }

    #[test]
    fn the_discovery_server_is_read_as_the_option_of_programs_is_written() {
        let read = |lds: &str| {
            let text = format!("{GRIPPER}lds: {lds}\n");
            let component = Component::from_yaml(&text, Path::new("examples/plant"));
            component.map(|component| component.lds.option("local"))
        };
        for (lds, option) in [
            ("none", None),
            ("embed", Some("embed")),
            (
                "embed=opc.tcp://10.0.0.2:4841",
                Some("embed=opc.tcp://10.0.0.2:4841"),
            ),
            ("opc.tcp://10.0.0.2", Some("opc.tcp://10.0.0.2")),
        ] {
            assert_eq!(read(lds), Ok(option.map(str::to_owned)));
        }
        for lds in ["embed=there", "embedded"] {
            let findings = read(lds).unwrap_err().sorted();
            assert_eq!(findings[0].code.as_str(), "P014", "{lds}: {findings:?}");
        }
    }

    #[test]
    fn all_faults_are_told_at_once_with_their_places_and_what_to_do() {
        let told = Component::from_yaml(FAULTS, Path::new(""))
            .unwrap_err()
            .render("faults.yaml", FAULTS);
        assert_eq!(told, TOLD, "\n{told}");
    }

    #[test]
    fn what_is_no_yaml_or_no_map_is_told_with_its_place() {
        for (text, expected) in [
            ("component: [", "P001"),
            ("", "P005"),
            ("- a\n- b\n", "P005"),
            ("component: *name\n", "P001"),
            ("a: 1\n---\nb: 2\n", "P001"),
            ("component: !name x\n", "P001"),
        ] {
            let findings = Component::from_yaml(text, Path::new(""))
                .unwrap_err()
                .sorted();
            assert_eq!(findings[0].code.as_str(), expected, "{text}: {findings:?}");
        }
        let deep = format!("component: {}", "[".repeat(10_000));
        assert!(Component::from_yaml(&deep, Path::new("")).is_err());
    }
}

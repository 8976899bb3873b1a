//! Reads the device of a component from YAML.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use skills::yaml::{DocumentNode, YamlFindingCode, YamlReader};
use skills::{Device, DeviceKinds, Driver, SensorRead};

use crate::addresses::{read_address, read_alias, read_line, read_register, read_unit};
use crate::{http_skill, kelvin, module, robotiq, schmalz, sensors, ur};

/// The devices of this crate.
#[derive(Debug, Clone, Copy, Default)]
pub struct Kinds;

impl DeviceKinds for Kinds {
    fn read(
        &self,
        node: &DocumentNode,
        folder: &Path,
        reader: &mut YamlReader<'_>,
    ) -> Option<Arc<dyn Device>> {
        match reader.map(node, NAMES)? {
            [Some(node), None, None, None, None] => read_robotiq(node, reader),
            [None, Some(node), None, None, None] => read_schmalz(node, reader),
            [None, None, Some(node), None, None] => read_robot(node, reader),
            [None, None, None, Some(node), None] => read_changer(node, reader),
            [None, None, None, None, Some(node)] => module::read(node, folder, reader),
            _ => {
                let message = format!("a device is exactly one of {}", NAMES.join(", "));
                reader.refuse(node, YamlFindingCode::Driver, message)
            }
        }
    }

    fn http(&self, node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Arc<dyn Driver>> {
        http_skill::read(node, reader)
    }

    fn sensor(
        &self,
        kind: &str,
        node: &DocumentNode,
        reader: &mut YamlReader<'_>,
    ) -> Option<SensorRead> {
        sensors::read(kind, node, reader)
    }
}

const NAMES: [&str; 5] = [
    "robotiq_2f85",
    "schmalz_ecbpi",
    "universal_robot",
    "kelvin_tool_changer",
    "mtp",
];

fn read_robotiq(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Arc<dyn Device>> {
    let [at, unit] = reader.map(node, ["at", "unit"])?;
    let at = reader
        .needed(at, "at", node.place)
        .and_then(|node| read_line(node, reader));
    let unit = unit.map_or(Some(robotiq::UNIT), |node| read_unit(node, reader));
    Some(Arc::new(robotiq::RobotiqGripper::new(at?, unit?)))
}

fn read_schmalz(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Arc<dyn Device>> {
    let [master, alias, grasp, release] =
        reader.map(node, ["master", "alias", "grasp_within", "release_within"])?;
    let master = reader
        .needed(master, "master", node.place)
        .and_then(|node| read_address(node, reader));
    let alias = match alias {
        Some(node) => read_alias(node, reader),
        None => Some("master1port1"),
    };
    let usual = schmalz::SchmalzTiming::default();
    let timing = schmalz::SchmalzTiming {
        grasp: grasp.map_or(Some(usual.grasp), |node| reader.duration(node))?,
        release: release.map_or(Some(usual.release), |node| reader.duration(node))?,
    };
    Some(Arc::new(schmalz::SchmalzGripper::new(
        master?, alias?, timing,
    )))
}

fn read_changer(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Arc<dyn Device>> {
    let keys = [
        "converter",
        "unit",
        "register",
        "robot",
        "tools",
        "plate",
        "within",
        "ready_within",
    ];
    let [
        at,
        unit,
        register,
        robot,
        tools,
        plate,
        within,
        ready_within,
    ] = reader.map(node, keys)?;
    let at = reader
        .needed(at, "converter", node.place)
        .and_then(|node| read_line(node, reader));
    let unit = unit.map_or(Some(1), |node| read_unit(node, reader));
    let register = match register {
        Some(node) => read_register(node, reader),
        None => Some(0),
    };
    let robot = robot.map(|node| skills::read_partner(node, reader));
    let plate = plate.map_or(Some(kelvin::PLATE), |node| {
        skills::read_numbers(node, (-10.0, 10.0), reader)
    });
    let ready_within =
        ready_within.map_or(Some(kelvin::READY_WITHIN), |node| reader.duration(node));
    let within = within.map_or(Some(MOVE_WITHIN), |node| reader.duration(node));
    let tools = reader
        .needed(tools, "tools", node.place)
        .map(|node| read_tools(node, reader));
    let settings = kelvin::KelvinSettings {
        converter: kelvin::Converter {
            at: at?,
            unit: unit?,
            register: register?,
            divider: kelvin::DIVIDER,
        },
        tools: tools?,
        plate: plate?,
        within: within?,
        ready_within: ready_within?,
    };
    // `None` for a robot that each run finds.
    let robot = match robot {
        Some(partner) => Some(partner?),
        None => None,
    };
    let mover = kelvin::Mover::Component(robot);
    Some(Arc::new(kelvin::KelvinChanger::new(settings, mover)))
}

fn read_tools(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Vec<kelvin::Tool> {
    let mut tools: Vec<kelvin::Tool> = Vec::new();
    for node in reader.list(node) {
        let Some(tool) = read_tool(node, reader) else {
            continue;
        };
        if tools
            .iter()
            .any(|known| known.number == tool.number || known.uri == tool.uri)
        {
            let message = "a tool of that number or URI is there already";
            reader
                .findings()
                .error(YamlFindingCode::WrongValue, node.place, message);
        }
        tools.push(tool);
    }
    tools
}

fn read_tool(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<kelvin::Tool> {
    let [number, uri, dock] = reader.map(node, ["number", "uri", "dock"])?;
    let number = reader.needed(number, "number", node.place);
    let number = number.and_then(|node| {
        let text = reader.text(node, "the number of a tool")?;
        let number = text.parse().ok().filter(|number| (1..=10).contains(number));
        number.or_else(|| {
            let message = format!("expected a number from 1 to 10, found `{text}`");
            reader.refuse(node, YamlFindingCode::WrongValue, message)
        })
    });
    let uri = reader.needed(uri, "uri", node.place);
    let uri = uri.and_then(|node| reader.text(node, "the ApplicationUri of a component"));
    let dock = reader.needed(dock, "dock", node.place)?;
    let numbers: Vec<f64> = reader
        .list(dock)
        .iter()
        .filter_map(|node| reader.number(node, (-10.0, 10.0)))
        .collect();
    let six = numbers.try_into().ok();
    let six = six.or_else(|| {
        let message = "a dock is six numbers: x, y, z in m and rotations about x, y, z in rad";
        reader.refuse(dock, YamlFindingCode::WrongValue, message.to_owned())
    });
    if six.is_some_and(|pose| !kelvin::is_vertical(pose)) {
        let message = format!(
            "a dock of this changer is not tilted: {}",
            kelvin::NOT_VERTICAL
        );
        return reader.refuse(dock, YamlFindingCode::WrongValue, message);
    }
    Some(kelvin::Tool {
        number: number?,
        uri: uri?.to_owned(),
        dock: six?,
    })
}

fn read_robot(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<Arc<dyn Device>> {
    let [host, rtde, secondary, reach] =
        reader.map(node, ["host", "rtde_port", "secondary_port", "reach"])?;
    let host = reader.needed(host, "host", node.place);
    let host = host.and_then(|node| {
        let text = reader.text(node, "a host name or address")?;
        if !text.is_empty() && !text.contains([':', '/', ' ', '@']) {
            return Some(text);
        }
        let message = format!("expected a host name or address, found `{text}`");
        reader.refuse(node, YamlFindingCode::WrongValue, message)
    });
    let mut port = |node: Option<&DocumentNode>, usual: u16| match node {
        Some(node) => read_port(node, reader),
        None => Some(usual),
    };
    let (rtde, secondary) = (port(rtde, ur::wire::PORT), port(secondary, ur::SECONDARY));
    let reach = reach.map_or(Some(ur::REACH), |node| reader.number(node, (0.1, 5.0)));
    let host = host?;
    Some(Arc::new(ur::UrRobot::new(ur::UrSettings {
        rtde: format!("{host}:{}", rtde?),
        secondary: format!("{host}:{}", secondary?),
        reach: reach?,
    })))
}

fn read_port(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<u16> {
    let text = reader.text(node, "a port")?;
    let port = text.parse().ok().filter(|port| *port > 0);
    port.or_else(|| {
        let message = format!("expected a port from 1 to 65535, found `{text}`");
        reader.refuse(node, YamlFindingCode::WrongValue, message)
    })
}

const MOVE_WITHIN: Duration = Duration::from_secs(60);

#[cfg(test)]
mod tests {
    use skills::Component;
    use std::path::Path;

    use super::*;

    fn told(device: &str) -> Result<String, String> {
        let text = format!(
            "component: x\napplication_uri: urn:x\nnamespace: 1\ndevice: {device}\nskills:\n  - {{name: Grasp, type: GraspSkillType, \
             driver: device}}\n"
        );
        match Component::from_yaml_with(&text, Path::new(""), &Kinds) {
            Ok(component) => Ok(format!("{:?}", component.device.unwrap())),
            Err(findings) => Err(findings.render("x.yaml", &text)),
        }
    }

    #[test]
    fn each_kind_of_device_is_read() {
        let lines = [
            (
                "{robotiq_2f85: {at: \"serial:/dev/ttyUSB0\"}}",
                "unit 9 at serial:/dev/ttyUSB0@115200",
            ),
            (
                "{robotiq_2f85: {at: tcp://10.0.0.7:502, unit: 3}}",
                "unit 3 at tcp://10.0.0.7:502",
            ),
            (
                "{schmalz_ecbpi: {master: 10.0.0.8:80, alias: master1port2}}",
                "master1port2",
            ),
            ("{universal_robot: {host: 10.0.0.9}}", "10.0.0.9:30004"),
            (
                "{kelvin_tool_changer: {converter: tcp://10.0.0.7:503, robot: opc.tcp://a:4840, tools: [{number: 2, uri: urn:t, dock: \
                 [0.1, 0, 0.2, 0, 0, -1.5]}]}}",
                "dock: [0.1, 0.0, 0.2, 0.0, 0.0, -1.5]",
            ),
        ];
        for (device, part) in lines {
            let read = told(device).unwrap();
            assert!(read.contains(part), "{read}");
        }
    }

    #[test]
    fn what_is_wrong_with_a_device_is_told_with_its_place() {
        let cases = [
            (
                "{}",
                "error[P022]: a device is exactly one of robotiq_2f85, ",
            ),
            ("{robotiq: {at: tcp://h:1}}", "unknown key `robotiq`"),
            (
                "{robotiq_2f85: {at: udp://h:1}}",
                "expected tcp://host:port, rtu+tcp://host:port or serial:path[@baud]",
            ),
            (
                "{robotiq_2f85: {at: tcp://h:1, unit: 0}}",
                "expected a number from 1 to 247, found `0`",
            ),
            (
                "{schmalz_ecbpi: {master: h:1, alias: a/b}}",
                "the alias of a device has letters",
            ),
            ("{schmalz_ecbpi: {alias: x}}", "`master` is missing"),
            (
                "{universal_robot: {host: \"h:1\"}}",
                "expected a host name or address, found `h:1`",
            ),
            (
                "{kelvin_tool_changer: {converter: tcp://h:1, robot: h, tools: [{number: 11, uri: urn:t, dock: [1]}]}}",
                "a dock is six numbers",
            ),
            (
                "{kelvin_tool_changer: {converter: tcp://h:1, robot: h, tools: [{number: 1, uri: urn:t, dock: [0, 0, 0, 1.5, 0, 0]}]}}",
                "a dock of this changer is not tilted",
            ),
        ];
        for (device, part) in cases {
            let findings = told(device).unwrap_err();
            assert!(findings.contains(part), "{findings}");
        }
    }
}

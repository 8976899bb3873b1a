//! The cell of the scenario: the simulators of the devices and their components, at the addresses
//! of the examples.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use plant_opcua::certificates;
use plant_opcua::pki::Pki;

use crate::pace::Speed;
use crate::stage::{LOOPBACK, swapped_tools};

/// A component: its name, its ApplicationUri, its YAML and the port of its endpoint.
pub(super) struct ToolsComponent {
    pub(super) name: &'static str,
    pub(super) uri: &'static str,
    yaml: &'static str,
    pub(super) port: Option<u16>,
}

/// The components. The last is a second robot, which is not used.
pub(super) const PARTS: [ToolsComponent; 6] = [
    ToolsComponent {
        name: "ur5",
        uri: "urn:example:ur5",
        yaml: include_str!("../../../examples/plant/ur5.yaml"),
        port: Some(24_840),
    },
    ToolsComponent {
        name: FINGERS,
        uri: "urn:example:robotiq-2f85",
        yaml: include_str!("../../../examples/plant/robotiq-2f85.yaml"),
        port: Some(10_254),
    },
    ToolsComponent {
        name: VACUUM,
        uri: "urn:example:schmalz-ecbpi",
        yaml: include_str!("../../../examples/plant/schmalz-ecbpi.yaml"),
        port: Some(10_255),
    },
    ToolsComponent {
        name: CHANGER,
        uri: "urn:example:tool-changer",
        yaml: include_str!("../../../examples/plant/tool-changer.yaml"),
        port: Some(14_840),
    },
    ToolsComponent {
        name: HANDLING,
        uri: "urn:example:handling",
        yaml: include_str!("../../../examples/plant/handling.yaml"),
        port: Some(12_346),
    },
    ToolsComponent {
        name: "robot",
        uri: "urn:example:robot",
        yaml: include_str!("../../../examples/plant/robot.yaml"),
        port: None,
    },
];

pub(super) const FINGERS: &str = "robotiq-2f85";
pub(super) const VACUUM: &str = "schmalz-ecbpi";
pub(super) const CHANGER: &str = "tool-changer";
pub(super) const HANDLING: &str = "handling";
pub(super) const LDS: &str = "ua-lds";
pub(super) const DEMO: &str = "demo";
pub(super) const DEMO_URI: &str = "urn:example:demo";

/// The ports of the simulators: RTDE, secondary interface, gripper, IO-Link master, converter.
pub(super) const DEVICE_PORTS: [u16; 5] = [30_004, 30_002, 1502, 8090, 1503];
const DOCKS: [[f64; 6]; 2] = [
    [0.3, 0.35, 0.2, 0.0, 0.0, 0.0],
    [-0.3, 0.35, 0.2, 0.0, 0.0, 0.0],
];

/// Returns the pose of the dock of a tool, the fingers or the vacuum gripper.
pub(super) fn dock(tool: &str, swapped: bool) -> [f64; 6] {
    let [first, second] = DOCKS;
    if (tool == FINGERS) == swapped {
        second
    } else {
        first
    }
}

/// Writes the YAML of the components into a directory. If `swapped`, each tool is in the other
/// tool's dock.
///
/// # Errors
/// A file cannot be written.
pub(super) fn write(directory: &Path, speed: Speed, swapped: bool) -> io::Result<()> {
    for part in &PARTS {
        let mut text = part.yaml.replace(
            "{simulated: {",
            &format!("{{simulated: {{time_scale: {}, ", speed.factor()),
        );
        text = text.replace("security: [None]", "security: [Basic256Sha256]");
        if swapped && part.name == CHANGER {
            text = swapped_tools(&text);
        }
        fs::write(directory.join(format!("{}.yaml", part.name)), text)?;
    }
    Ok(())
}

/// Returns the certificate store of a program.
pub(super) fn store(directory: &Path, name: &str) -> PathBuf {
    directory.join("pki").join(name)
}

/// Creates the certificates of the components and of the demo, which trust each other. The
/// discovery server creates its own certificate, and trusts them.
///
/// # Errors
/// A store cannot be written.
pub(super) fn trust_each_other(directory: &Path) -> io::Result<()> {
    let hosts = [LOOPBACK.to_owned()];
    let parts = PARTS.iter().map(|part| (part.name, part.uri));
    let programs: Vec<(&str, &str)> = parts.chain([(DEMO, DEMO_URI)]).collect();
    for (name, uri) in &programs {
        let store = Pki::open(store(directory, name)).map_err(io::Error::other)?;
        store.ensure_own_at(uri, &hosts).map_err(io::Error::other)?;
    }
    Pki::open(store(directory, LDS)).map_err(io::Error::other)?;
    for (name, _) in &programs {
        let own = certificate(directory, name);
        let others = programs.iter().map(|(other, _)| *other).chain([LDS]);
        for other in others.filter(|other| other != name) {
            trust(directory, other, &own)?;
        }
    }
    Ok(())
}

/// Makes all programs trust the certificate of the discovery server. Returns `false` until the
/// discovery server has created it.
///
/// # Errors
/// A store cannot be written.
pub(super) fn trust_discovery(directory: &Path) -> io::Result<bool> {
    let own = certificate(directory, LDS);
    if !own.is_file() {
        return Ok(false);
    }
    for part in &PARTS {
        trust(directory, part.name, &own)?;
    }
    Ok(true)
}

fn certificate(directory: &Path, name: &str) -> PathBuf {
    store(directory, name).join("own/cert.der")
}

fn trust(directory: &Path, name: &str, certificate: &Path) -> io::Result<()> {
    let certificate = certificate.display().to_string();
    let trusted = certificates::trust(&store(directory, name), &certificate);
    trusted.map(drop).map_err(io::Error::other)
}

/// Returns the simulators: the name of each, and its arguments after `simulate`.
pub(super) fn simulators(speed: Speed) -> [(&'static str, Vec<String>); 4] {
    let speed = ["--speed".to_owned(), speed.factor().to_string()];
    let of = |device: &str, more: &[String]| {
        let first = ["simulate", device].map(str::to_owned);
        first.into_iter().chain(more.iter().cloned()).collect()
    };
    let docked = (1..).zip(DOCKS).flat_map(|(number, [x, y, z, a, b, c])| {
        let tool = format!("{number}@{x},{y},{z},{a},{b},{c}");
        ["--tool".to_owned(), tool]
    });
    let docked: Vec<String> = docked.collect();
    [
        ("simulated-robot", of("universal-robot", &speed)),
        ("simulated-fingers", of("robotiq-2f85", &speed)),
        ("simulated-vacuum", of("schmalz-ecbpi", &speed)),
        ("simulated-changer", of("kelvin-tool-changer", &docked)),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_examples_are_those_of_the_story() {
        for part in &PARTS {
            let mut lines = vec![
                format!("component: {}", part.name),
                format!("application_uri: {}", part.uri),
            ];
            lines.extend(
                part.port
                    .map(|port| format!("endpoint: opc.tcp://127.0.0.1:{port}")),
            );
            for line in lines {
                assert!(
                    part.yaml.lines().any(|known| known == line),
                    "{}: {line}",
                    part.name
                );
            }
        }
    }

    #[test]
    fn tools_are_swapped_by_the_yaml_of_the_changer_alone() {
        let directory = std::env::temp_dir().join(format!("tools-{}", std::process::id()));
        fs::create_dir_all(&directory).unwrap();
        write(&directory, Speed::new(2.0).unwrap(), true).unwrap();
        let read = |name: &str| fs::read_to_string(directory.join(format!("{name}.yaml"))).unwrap();
        let changer = read(CHANGER);
        for line in [
            "      - {number: 2, uri: urn:example:robotiq-2f85, dock: [-0.3, 0.35, 0.2, 0, 0, 0]}",
            "      - {number: 1, uri: urn:example:schmalz-ecbpi, dock: [0.3, 0.35, 0.2, 0, 0, 0]}",
        ] {
            assert!(changer.lines().any(|known| known == line), "{changer}");
        }
        let handling = include_str!("../../../examples/plant/handling.yaml");
        assert_eq!(
            read(HANDLING),
            handling.replace("[None]", "[Basic256Sha256]")
        );
        assert!(dock(FINGERS, true)[0] < 0.0 && dock(VACUUM, true)[0] > 0.0);
        fs::remove_dir_all(directory).unwrap();
    }
}

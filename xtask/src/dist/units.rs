//! Units of systemd for all programs, from one template.

use std::fmt::Write as _;

/// The service of a program.
struct Unit {
    program: &'static str,
    about: &'static str,
    /// Further settings of the environment, which files in /etc/ua-bridge override.
    environment: &'static [&'static str],
    /// The configuration without which the service does not start.
    needs: Option<&'static str>,
    /// Whether SIGHUP reads the configuration again.
    reloads: bool,
    kind: Kind,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Single,
    /// One service for each file of its configuration, with devices at serial ports.
    Template,
}

const UNITS: [Unit; 9] = [
    Unit {
        program: "bridge-ros1",
        about: "ROS 1 graph",
        environment: &["UA_METRICS=127.0.0.1:9101"],
        needs: None,
        reloads: true,
        kind: Kind::Single,
    },
    Unit {
        program: "bridge-ros2",
        about: "ROS 2 domain",
        environment: &["UA_METRICS=127.0.0.1:9102"],
        needs: None,
        reloads: true,
        kind: Kind::Single,
    },
    Unit {
        program: "ua-server",
        about: "OPC UA server of the cell",
        environment: &["UA_METRICS=127.0.0.1:9103"],
        needs: None,
        reloads: true,
        kind: Kind::Single,
    },
    Unit {
        program: "ua-cell",
        about: "both bridges and the server of a small cell",
        environment: &["UA_METRICS=127.0.0.1:9107"],
        needs: None,
        reloads: true,
        kind: Kind::Single,
    },
    Unit {
        program: "ua-component",
        about: "component %i",
        environment: &["UA_COMPONENT=/etc/ua-bridge/components/%i.yaml"],
        needs: Some("/etc/ua-bridge/components/%i.yaml"),
        reloads: true,
        kind: Kind::Template,
    },
    Unit {
        program: "ua-mes",
        about: "processes and knowledge of the plant",
        environment: &[
            "UA_MES=/etc/ua-bridge/mes.yaml",
            "UA_METRICS=127.0.0.1:9104",
        ],
        needs: Some("/etc/ua-bridge/mes.yaml"),
        reloads: true,
        kind: Kind::Single,
    },
    Unit {
        program: "ua-lds",
        about: "Local Discovery Server",
        environment: &["UA_METRICS=127.0.0.1:9105"],
        needs: None,
        reloads: false,
        kind: Kind::Single,
    },
    Unit {
        program: "ua-station",
        about: "station of a level of the plant",
        environment: &["UA_STATION=%H", "UA_METRICS=127.0.0.1:9106"],
        needs: None,
        reloads: false,
        kind: Kind::Single,
    },
    Unit {
        program: "ua-gds",
        about: "Global Discovery Server of the plant",
        environment: &[],
        needs: None,
        reloads: false,
        kind: Kind::Single,
    },
];

/// Returns the file name and the text of each unit.
pub(crate) fn all(template: &str) -> Vec<(String, String)> {
    UNITS.iter().map(|unit| unit.written(template)).collect()
}

/// Returns the names of the units in commands of systemctl; a pattern for services of a template.
pub(crate) fn names() -> String {
    let names = UNITS.iter().map(|unit| match unit.kind {
        Kind::Single => format!("{}.service", unit.program),
        Kind::Template => format!("'{}@*.service'", unit.program),
    });
    names.collect::<Vec<_>>().join(" ")
}

impl Unit {
    fn written(&self, template: &str) -> (String, String) {
        let (name, state, devices) = match self.kind {
            Kind::Single => (
                format!("{}.service", self.program),
                format!("ua-bridge/{}", self.program),
                "PrivateDevices=yes\nPrivateUsers=yes",
            ),
            Kind::Template => (
                format!("{}@.service", self.program),
                "ua-bridge/components/%i".to_owned(),
                "DevicePolicy=closed\nDeviceAllow=char-ttyACM rw\nDeviceAllow=char-ttyS rw\n\
                 DeviceAllow=char-ttyUSB rw\nSupplementaryGroups=dialout",
            ),
        };
        let mut environment = String::new();
        for variable in self.environment {
            // Writing to a string does not fail.
            let _written = writeln!(environment, "Environment={variable}");
        }
        let condition = self
            .needs
            .map(|file| format!("ConditionPathExists={file}\n"));
        let reload = match self.reloads {
            true => "ExecReload=/bin/sh -c 'kill -HUP ${MAINPID}'\n",
            false => "",
        };
        let text = template
            .replace("@CONDITION@\n", &condition.unwrap_or_default())
            .replace("@ENVIRONMENT@\n", &environment)
            .replace("@RELOAD@\n", reload)
            .replace("@DEVICES@", devices)
            .replace("@STATE@", &state)
            .replace("@PROGRAM@", self.program)
            .replace("@UNIT@", &name)
            .replace("@ABOUT@", self.about);
        (name, text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEMPLATE: &str = include_str!("../../../packages/systemd/program.service");

    #[test]
    fn each_program_except_ua_space_has_a_complete_unit() {
        let units = all(TEMPLATE);
        let mut programs: Vec<&str> = UNITS.iter().map(|unit| unit.program).collect();
        programs.push("ua-space");
        programs.sort_unstable();
        let mut expected: Vec<&str> = crate::links::BRIDGES
            .into_iter()
            .chain(crate::links::NAMES)
            .collect();
        expected.sort_unstable();
        assert_eq!(programs, expected);
        for (name, text) in &units {
            let left = text.lines().find(|line| {
                !line.starts_with('#')
                    && !line.starts_with("SystemCallFilter=")
                    && line.contains('@')
            });
            assert_eq!(left, None, "{name}");
            assert!(
                text.contains("\nType=notify\n") && text.contains("\nWatchdogSec="),
                "{name}"
            );
        }
    }

    #[test]
    fn a_component_has_a_service_of_its_own_with_serial_ports() {
        let units = all(TEMPLATE);
        let (_, component) = units
            .iter()
            .find(|(name, _)| name == "ua-component@.service")
            .unwrap();
        assert!(component.contains("DeviceAllow=char-ttyUSB rw\n"));
        assert!(component.contains("StateDirectory=ua-bridge/components/%i\n"));
        assert!(component.contains("ConditionPathExists=/etc/ua-bridge/components/%i.yaml\n"));
        assert!(names().contains("'ua-component@*.service'"));
    }
}

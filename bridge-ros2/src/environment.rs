//! Variables of the ROS 2 environment that this bridge ignores because it joins the domain through
//! RustDDS.

/// Returns a warning for each variable that is set and has no effect on the bridge. `variable`
/// looks a variable up.
pub(crate) fn ignored(variable: impl Fn(&str) -> Option<String>) -> Vec<String> {
    let set = |name: &str| {
        let value = variable(name)?;
        let value = value.trim();
        (!value.is_empty()).then(|| value.to_owned())
    };
    let mut warnings = Vec::new();
    if let Some(servers) = set("ROS_DISCOVERY_SERVER").filter(|list| list.contains(|c| c != ';')) {
        warnings.push(format!(
            "ROS_DISCOVERY_SERVER is `{servers}`, but the bridge does not support discovery servers: it \
             does not discover nodes that use only the server. Unset the variable on the robot, or run the \
             bridge where multicast reaches the nodes; list hosts that multicast does not reach in \
             ROS_STATIC_PEERS"
        ));
    }
    if let Some(rmw) = set("RMW_IMPLEMENTATION").filter(|rmw| !KNOWN_RMW.contains(&rmw.as_str())) {
        let consequence = match rmw.contains("zenoh") {
            true => "the bridge does not discover nodes that use it",
            false => "the bridge is not tested with it",
        };
        warnings.push(format!(
            "RMW_IMPLEMENTATION is `{rmw}`, and the bridge speaks DDS as Fast DDS and Cyclone DDS do: {consequence}. Run \
             the nodes with rmw_fastrtps_cpp or rmw_cyclonedds_cpp"
        ));
    }
    for name in PROFILES {
        if let Some(file) = set(name) {
            warnings.push(format!(
                "{name} is `{file}`, but the bridge does not read profiles: choose its network interface \
                 with --ros-interface, and list hosts that multicast does not reach in ROS_STATIC_PEERS"
            ));
        }
    }
    warnings
}

/// The RMW implementations with which the bridge is tested.
const KNOWN_RMW: [&str; 3] = [
    "rmw_fastrtps_cpp",
    "rmw_fastrtps_dynamic_cpp",
    "rmw_cyclonedds_cpp",
];
/// The variables that name profiles of Fast DDS and the configuration of Cyclone DDS.
const PROFILES: [&str; 3] = [
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "CYCLONEDDS_URI",
];

#[cfg(test)]
mod tests {
    use super::*;

    fn of(variables: &[(&str, &str)]) -> Vec<String> {
        ignored(|name| {
            let found = variables.iter().find(|(known, _)| *known == name);
            found.map(|(_, value)| (*value).to_owned())
        })
    }

    #[test]
    fn a_variable_without_effect_is_one_warning_with_its_value() {
        for (name, value) in [
            ("ROS_DISCOVERY_SERVER", "10.0.0.5:11811"),
            ("ROS_DISCOVERY_SERVER", ";10.0.0.5:11811"),
            ("RMW_IMPLEMENTATION", "rmw_zenoh_cpp"),
            ("RMW_IMPLEMENTATION", "rmw_connextdds"),
            ("FASTRTPS_DEFAULT_PROFILES_FILE", "/p.xml"),
            ("FASTDDS_DEFAULT_PROFILES_FILE", "/p.xml"),
            ("CYCLONEDDS_URI", "file:///c.xml"),
        ] {
            let warnings = of(&[(name, value)]);
            let [warning] = warnings.as_slice() else {
                panic!("{name}: {warnings:?}")
            };
            assert!(
                warning.starts_with(&format!("{name} is `{value}`")),
                "{warning}"
            );
        }
    }

    #[test]
    fn a_variable_that_is_empty_or_has_effect_is_none() {
        let silent = [
            ("ROS_DISCOVERY_SERVER", ""),
            ("RMW_IMPLEMENTATION", " "),
            ("CYCLONEDDS_URI", ""),
            ("ROS_DOMAIN_ID", "7"),
        ];
        assert_eq!(of(&silent), [""; 0]);
        for known in KNOWN_RMW {
            assert_eq!(of(&[("RMW_IMPLEMENTATION", known)]), [""; 0]);
        }
    }
}

//! The dependency rules of the workspace: the crates that each crate must not reach.

use system_tests::{forbidden, tree};

/// IO, clocks and libraries of a single ROS version or OPC UA implementation.
const IMPURE: &[&str] = &[
    "tokio*",
    "async-std",
    "smol",
    "mio",
    "socket2",
    "hyper*",
    "reqwest",
    "rosrust*",
    "roslibrust*",
    "rustdds",
    "ros2-client",
    "async-opcua",
    "async-opcua-server",
    "async-opcua-client",
    "iceoryx2*",
    "mdns-sd",
    "oxigraph",
];

fn does_not_reach(package: &str, banned: &[&str]) {
    let tree = tree(package);
    assert!(
        tree.starts_with(&format!("{package} v")),
        "cargo tree begins with the package itself: {tree}"
    );
    let found = forbidden(&tree, banned);
    assert!(found.is_empty(), "{package} reaches {found:?}:\n{tree}");
}

#[test]
fn uadp_reaches_no_io() {
    does_not_reach("uadp", IMPURE);
}

#[test]
fn uadp_knows_neither_ros_nor_the_space_nor_yaml() {
    does_not_reach(
        "uadp",
        &[
            "messages",
            "mappings",
            "bridge-*",
            "ros_message",
            "serde*",
            "tcpros",
            "transport",
        ],
    );
}

#[test]
fn messages_reaches_no_io() {
    does_not_reach("messages", IMPURE);
}

#[test]
fn mappings_reaches_no_io() {
    does_not_reach("mappings", IMPURE);
}

#[test]
fn bridge_core_reaches_no_io() {
    does_not_reach("bridge-core", IMPURE);
}

#[test]
fn bridge_core_knows_no_carrier() {
    does_not_reach("bridge-core", &["tcpros", "transport", "bridge-node"]);
}

#[test]
fn tcpros_is_a_ros_1_library_that_knows_no_space() {
    does_not_reach(
        "tcpros",
        &[
            "uadp",
            "messages",
            "mappings",
            "bridge-*",
            "transport",
            "rosrust*",
            "rustdds",
        ],
    );
}

#[test]
fn ros2_node_is_a_ros_2_library_that_knows_no_space() {
    does_not_reach(
        "ros2-node",
        &[
            "mappings",
            "bridge-*",
            "transport",
            "tcpros",
            "type-files",
            "ros2-client",
            "async-opcua",
        ],
    );
}

#[test]
fn transport_does_not_know_what_a_datagram_means() {
    does_not_reach(
        "transport",
        &["uadp", "messages", "mappings", "bridge-*", "tcpros"],
    );
}

#[test]
fn http_requests_alone_have_no_tls_and_know_no_space() {
    does_not_reach(
        "http-client",
        &[
            "rustls*",
            "tokio-rustls",
            "ring",
            "uadp",
            "mappings",
            "bridge-*",
            "transport",
            "service",
        ],
    );
    does_not_reach("tcpros", &["rustls*", "tokio-rustls", "ring"]);
}

#[test]
fn tls_of_clients_knows_no_space() {
    does_not_reach(
        "tls-client",
        &[
            "hyper*",
            "uadp",
            "mappings",
            "bridge-*",
            "transport",
            "service",
        ],
    );
}

#[test]
fn tls_of_servers_knows_neither_pages_nor_the_space() {
    does_not_reach(
        "tls-server",
        &[
            "hyper*",
            "async-opcua*",
            "uadp",
            "mappings",
            "bridge-*",
            "transport",
            "service",
        ],
    );
}

#[test]
fn json_values_reaches_no_io_and_knows_no_space() {
    does_not_reach("json-values", IMPURE);
    does_not_reach(
        "json-values",
        &["messages", "mappings", "bridge-*", "tcpros", "transport"],
    );
}

#[test]
fn the_broker_knows_neither_ros_nor_the_router() {
    does_not_reach(
        "broker",
        &[
            "bridge-*",
            "tcpros",
            "rosrust*",
            "ros2-client",
            "rustdds",
            "async-opcua",
            "async-opcua-server",
            "openssl*",
        ],
    );
}

#[test]
fn the_shell_knows_no_ros_library() {
    does_not_reach(
        "bridge-node",
        &[
            "tcpros",
            "rosrust*",
            "ros2-client",
            "rustdds",
            "async-opcua",
            "async-opcua-server",
        ],
    );
}

#[test]
fn what_every_program_needs_knows_no_space() {
    let space = [
        "uadp",
        "messages",
        "mappings",
        "bridge-*",
        "tcpros",
        "transport",
        "rustdds",
        "async-opcua*",
        "plant-opcua",
    ];
    does_not_reach("service", &space);
    for package in ["discovery", "ua-gds", "ua-station"] {
        let space = ["mappings", "bridge-*", "tcpros", "transport", "rustdds"];
        does_not_reach(package, &space);
    }
}

#[test]
fn each_bridge_knows_its_own_ros_library_only() {
    does_not_reach(
        "bridge-ros1",
        &[
            "ros2-client",
            "ros2-node",
            "rustdds",
            "bridge-ros2",
            "rosrust*",
        ],
    );
    does_not_reach(
        "bridge-ros2",
        &["tcpros", "bridge-ros1", "ros2-client", "rosrust*"],
    );
}

#[test]
fn the_server_knows_no_ros_library() {
    does_not_reach(
        "ua-server",
        &["tcpros", "ros2-client", "rustdds", "rosrust*"],
    );
}

#[test]
fn the_page_knows_no_ros_and_opc_ua_library() {
    does_not_reach(
        "supervisor",
        &[
            "tcpros",
            "ros2-client",
            "rustdds",
            "rosrust*",
            "async-opcua*",
            "plant-opcua",
            "ua-server",
            "ua-space",
        ],
    );
}

#[test]
fn what_the_plant_thinks_with_reaches_no_io_and_knows_no_space() {
    for package in [
        "build-info",
        "documents",
        "mtp",
        "nodeset-files",
        "program",
        "registry",
        "rml",
        "step-files",
        "trust",
        "uri-text",
        "xml-text",
    ] {
        does_not_reach(package, IMPURE);
        does_not_reach(
            package,
            &[
                "uadp",
                "messages",
                "mappings",
                "bridge-*",
                "tcpros",
                "transport",
            ],
        );
    }
}

#[test]
fn mdns_knows_no_space_and_no_opc_ua_library() {
    does_not_reach(
        "mdns",
        &[
            "uadp",
            "mappings",
            "bridge-*",
            "tcpros",
            "rustdds",
            "discovery",
            "plant-opcua",
            "async-opcua*",
        ],
    );
}

#[test]
fn who_fetches_keys_knows_neither_ros_nor_skills() {
    does_not_reach(
        "plant-keys",
        &["tcpros", "rustdds", "skills", "discovery", "knowledge"],
    );
}

#[test]
fn the_opc_ua_library_knows_neither_skills_nor_who_is_there_nor_the_space() {
    does_not_reach(
        "plant-opcua",
        &[
            "skills",
            "discovery",
            "registry",
            "knowledge",
            "uadp",
            "messages",
            "mappings",
            "bridge-*",
            "tcpros",
            "transport",
            "oxigraph",
        ],
    );
}

#[test]
fn skills_know_neither_discovery_nor_rdf_nor_the_space_nor_ros() {
    does_not_reach(
        "skills",
        &[
            "discovery",
            "registry",
            "mdns-sd",
            "knowledge",
            "oxigraph",
            "uadp",
            "messages",
            "bridge-*",
            "tcpros",
            "transport",
            "devices",
        ],
    );
}

#[test]
fn devices_know_neither_discovery_nor_rdf_nor_the_space_nor_ros() {
    does_not_reach(
        "devices",
        &[
            "discovery",
            "registry",
            "mdns-sd",
            "knowledge",
            "oxigraph",
            "uadp",
            "messages",
            "bridge-*",
            "tcpros",
            "transport",
        ],
    );
}

#[test]
fn the_mes_knows_no_devices() {
    does_not_reach("ua-mes", &["devices", "tokio-modbus", "serial2"]);
}

#[test]
fn a_station_knows_neither_skills_nor_rdf_nor_ros() {
    does_not_reach(
        "ua-station",
        &["skills", "devices", "knowledge", "oxigraph", "tcpros"],
    );
}

#[test]
fn who_issues_certificates_knows_neither_skills_nor_rdf_nor_ros() {
    does_not_reach(
        "ua-gds",
        &[
            "skills",
            "devices",
            "knowledge",
            "oxigraph",
            "tcpros",
            "rustdds",
        ],
    );
}

#[test]
fn discovery_knows_neither_skills_nor_rdf() {
    does_not_reach("discovery", &["skills", "knowledge", "oxigraph", "tcpros"]);
}

#[test]
fn knowledge_has_no_sessions_of_opc_ua() {
    does_not_reach(
        "knowledge",
        &[
            "async-opcua",
            "plant-opcua",
            "skills",
            "discovery",
            "uadp",
            "bridge-*",
            "tcpros",
        ],
    );
}

#[test]
fn no_program_of_the_plant_knows_a_ros_library() {
    for program in ["ua-component", "ua-gds", "ua-mes", "ua-station"] {
        does_not_reach(program, &["tcpros", "rosrust*", "ros2-client", "rustdds"]);
    }
}

#[test]
fn the_check_sees_what_a_shell_reaches() {
    assert!(forbidden(&tree("bridge-node"), IMPURE).contains(&"tokio".to_owned()));
}

/// The programs that `ua-bridge` contains, and the programs each of them may use.
const NAMES_OF_UA_BRIDGE: [(&str, &[&str]); 6] = [
    ("ua-component", &[]),
    ("ua-gds", &[]),
    ("ua-mes", &["ua-component"]),
    ("ua-server", &["ua-component"]),
    ("ua-space", &[]),
    ("ua-station", &[]),
];

#[test]
fn only_ua_bridge_depends_on_the_programs_that_it_acts_as() {
    let all = NAMES_OF_UA_BRIDGE.map(|(name, _)| name);
    for (package, _) in NAMES_OF_UA_BRIDGE {
        does_not_reach(package, &["bridge-ros1", "bridge-ros2"]);
    }
    for package in ["bridge-ros1", "bridge-ros2", "demo"] {
        does_not_reach(package, &all);
        does_not_reach(package, &["ua-bridge"]);
    }
    for (package, used) in NAMES_OF_UA_BRIDGE {
        let is_banned = |name: &&str| *name != package && !used.contains(name);
        let banned: Vec<&str> = all.into_iter().filter(is_banned).collect();
        does_not_reach(package, &banned);
    }
    let mut linked = vec!["bridge-ros1", "bridge-ros2"];
    linked.extend(all);
    let found = forbidden(&tree("ua-bridge"), &linked);
    assert_eq!(found, linked, "ua-bridge links them all");
}

#[test]
fn a_bridge_alone_has_no_opc_ua_library() {
    for bridge in ["bridge-ros1", "bridge-ros2"] {
        does_not_reach(bridge, &["async-opcua*", "plant-*", "discovery"]);
    }
    does_not_reach("plant-keys", &["async-opcua-server", "discovery"]);
}

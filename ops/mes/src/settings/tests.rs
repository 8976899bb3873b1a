use super::*;
use crate::process::{BadEnd, Compare, GivenParameter, StepCondition, Test};

const EXAMPLE: &str = include_str!("../../../../examples/plant/mes.yaml");

#[test]
fn the_example_is_read_as_it_stands() {
    let settings = Settings::from_yaml(EXAMPLE, Path::new("examples/plant"))
        .unwrap_or_else(|findings| panic!("{}", findings.render("mes.yaml", EXAMPLE)));
    let [process] = settings.processes.as_slice() else {
        panic!("{settings:?}")
    };
    assert_eq!(process.iri, "urn:example:process:move-part");
    let steps: Vec<_> = process
        .steps
        .iter()
        .map(|step| step.name.as_str())
        .collect();
    assert_eq!(steps, ["pick", "place"]);
    let grasp = process.steps[0]
        .needs
        .iter()
        .find(|need| need.role == SkillRole::Grasp)
        .unwrap();
    assert_eq!(
        grasp.capability.as_deref(),
        Some("urn:example:capability:grasp")
    );
    assert_eq!(grasp.skill_type, Some(ParameterType::own("GraspSkillType")));
    assert_eq!(
        settings.knowledge[0].path,
        Path::new("examples/plant/capabilities.ttl")
    );
}

#[test]
fn all_that_is_wrong_is_told_at_once_with_its_line() {
    let text = "mes: a b\napplication_uri: urn:x\nnamespace: 0\nsparql: 0.0.0.0:80\nmanifests:\n  - {name: m}\nprocesses:\n  - process: not an iri\n    pick_and_place: {pick: [1, 2], place: [0, 0, 0, 0, 0, 0]}\n    steps:\n      - step: pick\n        needs: {grip: urn:x}\n";
    let told = Settings::from_yaml(text, Path::new(""))
        .unwrap_err()
        .render("mes.yaml", text);
    for wanted in [
        "mes.yaml:1:6",
        "mes.yaml:3:12",
        "address of loopback",
        "`file` is missing",
        "`not an iri` is no IRI",
        "six numbers",
        "`grip` is not known here; known are ptp, linear, grasp, release",
        "no step says who is to be `grasp`",
    ] {
        assert!(told.contains(wanted), "{wanted}:\n{told}");
    }
}

#[test]
fn steps_that_are_done_by_themselves_have_parameters() {
    let text = "mes: m\napplication_uri: urn:x\nnamespace: 5\nprocesses:\n  - process: urn:p\n    steps:\n      - {step: grip, needs: {skill: {type: GraspSkillType}}, parameters: {Force: 12.5, Name: a, All: [1, true], Width: {value: 31, unit: mm}}}\n";
    let settings = Settings::from_yaml(text, Path::new("")).unwrap();
    let [step] = settings.processes[0].steps.as_slice() else {
        panic!()
    };
    let given = |name: &str, value, unit: Option<&str>| GivenParameter {
        name: name.to_owned(),
        value,
        unit: unit.map(str::to_owned),
        result: None,
        query: None,
    };
    let expected = [
        given("Force", serde_json::json!(12.5), None),
        given("Name", "a".into(), None),
        given("All", serde_json::json!([1, true]), None),
        given("Width", 31.into(), Some("mm")),
    ];
    assert_eq!(step.parameters, expected);
}

#[test]
fn a_step_names_the_component_that_does_it() {
    let text = "mes: m\napplication_uri: urn:x\nnamespace: 5\nprocesses:\n  - process: urn:p\n    steps:\n      - {step: grip, needs: {skill: urn:c:grasp}}\n      - {step: hold, needs: {skill: urn:c:hold}, by: attached-tool}\n      - {step: let go, needs: {skill: urn:c:release}, by: {component_of: grip}}\n";
    let settings = Settings::from_yaml(text, Path::new("")).unwrap();
    let by: Vec<By> = settings.processes[0]
        .steps
        .iter()
        .map(|step| step.by)
        .collect();
    assert_eq!(by, [By::Any, By::AttachedTool, By::SameAs(0)]);
    let wrong = text.replace("component_of: grip", "component_of: let go");
    let told = Settings::from_yaml(&wrong, Path::new(""))
        .unwrap_err()
        .render("mes.yaml", &wrong);
    let expected = "no earlier step is called `let go`; there are grip, hold";
    assert!(told.contains(expected), "{told}");
}

#[test]
fn steps_have_an_order_conditions_and_a_time_limit() {
    let text = "mes: m
application_uri: urn:x
namespace: 5
processes:
  - process: urn:p
    steps:
      - {step: fill, needs: {skill: urn:c:fill}}
      - {step: heat, needs: {skill: urn:c:heat}, after: [], within: 7 s}
      - {step: stir, needs: {skill: urn:c:stir}, after: [heat, fill]}
      - step: drain
        needs: {skill: urn:c:drain}
        after: stir
        when: [{of: fill, result: Level, is: '>= 20'}, {of: stir, ended: timed out, not: true}]
      - {step: rinse, needs: {skill: urn:c:rinse}, when: {of: heat, result: Fault, is: false}}
";
    let settings = Settings::from_yaml(text, Path::new("")).unwrap();
    let steps = &settings.processes[0].steps;
    let waits = (0..)
        .zip(steps)
        .map(|(number, step)| step.after.clone().ok_or(number));
    let waits: Vec<_> = waits.collect();
    assert_eq!(
        waits,
        [Err(0), Ok(vec![]), Ok(vec![0, 1]), Ok(vec![2]), Err(4)]
    );
    assert_eq!(steps[1].within, Some(std::time::Duration::from_secs(7)));
    let condition = |step, test, is_negated| StepCondition {
        step,
        test,
        is_negated,
    };
    let level = Test::Result {
        name: "Level".to_owned(),
        compare: Compare::GreaterOrEqual,
        value: 20.into(),
    };
    let both = vec![
        condition(0, level, false),
        condition(2, Test::Ended(BadEnd::TimedOut), true),
    ];
    assert_eq!(steps[3].when, [both]);
    let fault = Test::Result {
        name: "Fault".to_owned(),
        compare: Compare::Equal,
        value: false.into(),
    };
    assert_eq!(steps[4].when, [vec![condition(1, fault, false)]]);
    for (right, wrong, why) in [
        (
            "after: stir",
            "after: rinse",
            "no earlier step is called `rinse`",
        ),
        ("ended: timed out", "ended: late", "`failed` or `timed out`"),
        (
            "result: Fault, is: false",
            "result: Fault",
            "`is` is missing",
        ),
        (
            "result: Fault, is: false",
            "ended: failed, is: 1",
            "about a result or about an end",
        ),
    ] {
        let wrong = text.replace(right, wrong);
        let told = Settings::from_yaml(&wrong, Path::new("")).unwrap_err();
        let told = told.render("mes.yaml", &wrong);
        assert!(told.contains(why), "{told}");
    }
}

#[test]
fn a_query_of_a_parameter_is_checked_with_the_yaml() {
    let yaml = |parameter: &str| {
        format!(
            "mes: m\napplication_uri: urn:x\nnamespace: 5\nprocesses:\n  - process: urn:p\n    steps:\n      - step: grip\n        needs: {{skill: urn:c:grasp}}\n        parameters:\n          Width: {parameter}\n"
        )
    };
    let text = yaml("{query: 'SELECT ?w { ?part <urn:width> ?w }', unit: mm}");
    let settings = Settings::from_yaml(&text, Path::new("")).unwrap();
    let given = &settings.processes[0].steps[0].parameters[0];
    assert_eq!(given.shown(), "Width (query `Width`)");
    assert_eq!(
        (given.unit.as_deref(), given.value.is_null()),
        (Some("mm"), true)
    );
    for (parameter, wanted) in [
        (
            "{query: 'SELECT ?a ?b { ?a ?p ?b }'}",
            "it selects 2 variables",
        ),
        (
            "{query: 'SELECT ?a { ?a ?p ?b }', value: 3}",
            "a query is the value",
        ),
        ("{query_name: width}", "`query` is missing"),
    ] {
        let text = yaml(parameter);
        let findings = Settings::from_yaml(&text, Path::new("")).unwrap_err();
        let told = findings.render("mes.yaml", &text);
        assert!(
            told.contains(wanted) && told.contains("mes.yaml:10:"),
            "{told}"
        );
    }
}

#[test]
fn nodesets_come_from_a_folder_or_a_url_that_is_checked() {
    let read = |origin: &str| {
        let text =
            format!("mes: m\napplication_uri: urn:x\nnamespace: 5\nnodeset_folder: '{origin}'\n");
        let read = Settings::from_yaml(&text, Path::new("plant"));
        let read = read.map_err(|findings| findings.render("mes.yaml", &text));
        read.map(|settings| settings.nodeset_folder.unwrap())
    };
    let folder = read("sets").unwrap();
    let NodeSetOrigin::Folder(folder) = folder else {
        panic!("{folder:?}")
    };
    assert_eq!(folder.path, Path::new("plant/sets"));
    for url in ["http://h/{uri}.xml", "https://h/nodesets/index.json"] {
        let origin = read(url).unwrap();
        assert!(matches!(origin, NodeSetOrigin::Url(_)), "{origin:?}");
    }
    for (url, why) in [
        ("ftp://h/{uri}", "does not begin with http:// or https://"),
        ("http://h/nodesets/", "the URL has no {uri}"),
        ("http://h:x/{uri}", "`x` is no port"),
    ] {
        let told = read(url).unwrap_err();
        assert!(
            told.contains(why) && told.contains("mes.yaml:4:17"),
            "{told}"
        );
    }
}

#[test]
fn servers_are_named_by_endpoints_uris_and_discovery() {
    let text = "mes: m\napplication_uri: urn:x\nnamespace: 5\nservers:\n  - opc.tcp://press:4840\n  - {server: urn:example:robot, start: ['nsu=urn:robot;i=5', i=2253], nodes: 100, depth: 4, every: 30 s}\n  - discovered\n";
    let settings = Settings::from_yaml(text, Path::new("")).unwrap();
    let which: Vec<&NamedServers> = settings.servers.iter().map(|one| &one.which).collect();
    assert_eq!(
        which,
        [
            &NamedServers::Endpoint("opc.tcp://press:4840".to_owned()),
            &NamedServers::Application("urn:example:robot".to_owned()),
            &NamedServers::Discovered,
        ]
    );
    let robot = &settings.servers[1];
    let start: Vec<String> = robot.start.iter().map(knowledge::NodeName::id).collect();
    assert_eq!(
        start,
        [
            "nsu=urn:robot;i=5",
            "nsu=http://opcfoundation.org/UA/;i=2253"
        ]
    );
    assert_eq!((robot.limits.nodes, robot.limits.depth), (100, 4));
    assert_eq!(robot.every, std::time::Duration::from_secs(30));
    let wrong = "mes: m\napplication_uri: urn:x\nnamespace: 5\nservers:\n  - press\n  - {server: discovered, start: [ns=2;i=5], nodes: 0, every: 10 ms}\n  - discovered\n  - {start: [i=85]}\n";
    let told = Settings::from_yaml(wrong, Path::new(""))
        .unwrap_err()
        .render("mes.yaml", wrong);
    for wanted in [
        "mes.yaml:5:5",
        "an ApplicationUri or `discovered`, found `press`",
        "as nsu=urn:example:press;i=5001",
        "a number from 1 to 100000, found `0`",
        "every second at most",
        "`server` is missing",
    ] {
        assert!(told.contains(wanted), "{wanted}:\n{told}");
    }
    let twice = "mes: m\napplication_uri: urn:x\nnamespace: 5\nservers: [discovered, discovered]\n";
    let told = Settings::from_yaml(twice, Path::new(""))
        .unwrap_err()
        .render("mes.yaml", twice);
    assert!(told.contains("two of the server `discovered`"), "{told}");
}

#[test]
fn users_of_other_hosts_have_any_address_and_programs_of_this_host_loopback() {
    let read = |key: &str| {
        let text = format!("mes: m\napplication_uri: urn:x\nnamespace: 5\n{key}\n");
        let settings = Settings::from_yaml(&text, Path::new(""));
        settings.map_err(|findings| findings.render("mes.yaml", &text))
    };
    let tls = |key: &str| read(key).unwrap().sparql_tls;
    assert_eq!(tls("rules: false"), None);
    let any = Some("0.0.0.0:8443".parse().unwrap());
    assert_eq!(tls("sparql_tls: 0.0.0.0:8443"), any);
    for (key, why) in [
        (
            "sparql_tls: mes",
            "an address with a port, as 0.0.0.0:8443, found `mes`",
        ),
        (
            "sparql: 0.0.0.0:8087",
            "an address of loopback, as 127.0.0.1:8087",
        ),
    ] {
        let told = read(key).unwrap_err();
        assert!(told.contains(why) && told.contains("mes.yaml:4:"), "{told}");
    }
}

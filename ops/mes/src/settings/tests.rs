use super::*;

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
        .find(|need| need.role == Role::Grasp)
        .unwrap();
    assert_eq!(
        grasp.capability.as_deref(),
        Some("urn:example:capability:grasp")
    );
    assert_eq!(grasp.skill_type, Some(TypeName::own("GraspSkillType")));
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
    let given = |name: &str, value, unit: Option<&str>| Given {
        name: name.to_owned(),
        value,
        unit: unit.map(str::to_owned),
        result: None,
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

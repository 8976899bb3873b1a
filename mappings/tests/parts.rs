//! One mapping on several hosts, each with the definitions of its own robots.
use mappings::{Checked, Code, Mapping, Severity, SpaceId};

/// The definitions of `their_msgs` are not available here.
const CELL: &str = "\
spaces: [{id: 1}, {id: 2}, {id: 3}]
namespaces: {2: urn:x}
variables:
  - node: ns=2;i=1
    name: Arm
    origin: 1
    ros:
      - {topic: /arm, type: std_msgs/Float64}
      - {space: 2, topic: /arm, type: their_msgs/Arm, field: joint}
";

fn check(text: &str) -> Checked {
    Mapping::from_yaml(text, "cell.yaml")
}

fn space(number: u16) -> SpaceId {
    SpaceId::new(number).unwrap()
}

fn for_spaces(text: &str, spaces: &[u16]) -> Checked {
    let spaces: Vec<SpaceId> = spaces.iter().copied().map(space).collect();
    check(text).for_spaces(&spaces)
}

fn told(checked: &Checked) -> Vec<(Code, Severity)> {
    let findings = checked.findings.iter();
    findings.map(|one| (one.code, one.severity)).collect()
}

#[test]
fn a_type_that_only_another_host_needs_stops_only_its_program() {
    let all = check(CELL);
    assert!(all.mapping.is_none());
    assert_eq!(all.outline().unwrap().variables().len(), 1);
    for stopped in [&[2][..], &[2, 3]] {
        let part = for_spaces(CELL, stopped);
        assert!(part.mapping.is_none());
        let error = [(Code::UnknownMessageType, Severity::Error)];
        assert_eq!(told(&part), error);
    }
    for free in [&[0][..], &[1], &[3], &[1, 3]] {
        let part = for_spaces(CELL, free);
        let warning = [(Code::UnknownMessageType, Severity::Warning)];
        assert_eq!(told(&part), warning);
        let help = part.findings[0].help.clone().unwrap();
        assert!(
            help.contains("this stops only the program that serves space 2"),
            "{help}"
        );
        let mapping = part.mapping.unwrap();
        assert_eq!(mapping.bindings(space(1)).count(), 1);
    }
}

#[test]
fn a_field_that_a_type_has_on_another_host_only_is_left_to_it() {
    let text = CELL.replace(
        "their_msgs/Arm, field: joint",
        "std_msgs/Float64, field: angle",
    );
    assert!(for_spaces(&text, &[2]).mapping.is_none());
    let part = for_spaces(&text, &[1]);
    assert_eq!(told(&part), [(Code::UnknownField, Severity::Warning)]);
    assert!(part.mapping.is_some());
}

#[test]
fn types_of_two_hosts_that_do_not_fit_stop_only_who_has_both() {
    let text = CELL.replace("their_msgs/Arm, field: joint", "std_msgs/Int32");
    for free in [1, 2] {
        let part = for_spaces(&text, &[free]);
        assert_eq!(told(&part), [(Code::BindingsDiffer, Severity::Warning)]);
        let help = part.findings[0].help.clone().unwrap();
        assert!(help.contains("the spaces 1 and 2"), "{help}");
        assert!(part.mapping.is_some());
    }
    assert!(for_spaces(&text, &[1, 2]).mapping.is_none());
}

#[test]
fn what_is_wrong_on_every_host_stops_every_program() {
    let text = CELL.replace(
        "topic: /arm, type: their_msgs/Arm",
        "topic: arm!, type: their_msgs/Arm",
    );
    assert!(check(&text).outline().is_none());
    for part in [0, 1, 2, 3] {
        let part = for_spaces(&text, &[part]);
        assert!(part.mapping.is_none());
        assert!(told(&part).contains(&(Code::RosTopic, Severity::Error)));
    }
}

#[test]
fn a_part_with_more_findings_than_are_shown_runs_all_the_same() {
    use std::fmt::Write as _;
    let mut text = "spaces: [{id: 1}, {id: 2}]\nnamespaces: {2: urn:x}\nvariables:\n".to_owned();
    for number in 1..=300 {
        writeln!(
            text,
            "  - {{node: ns=2;i={number}, name: v{number}, origin: 1, ros: {{space: 2, topic: /t{number}, type: x_msgs/X}}}}"
        )
        .unwrap();
    }
    let part = for_spaces(&text, &[1]);
    assert!(
        part.findings
            .iter()
            .all(|one| one.severity == Severity::Warning)
    );
    assert_eq!(part.mapping.unwrap().variables().len(), 300);
    assert!(for_spaces(&text, &[2]).mapping.is_none());
}

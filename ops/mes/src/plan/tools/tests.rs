use super::*;

const A: &str = "urn:example:a";
const B: &str = "urn:example:b";
const CHANGER: &str = "urn:example:changer";
const SECOND: &str = "urn:example:second";

fn step(number: usize) -> ToolStep {
    ToolStep {
        number,
        name: format!("step {number}"),
    }
}

/// Checks whether a component may do a step that comes after some steps, and that A and B can do.
fn check(
    tools: &AttachedTools,
    by: By,
    behind: &[usize],
    component: &str,
) -> Result<(), ToolFault> {
    let user = ToolUser {
        number: 9,
        by,
        behind: &behind.iter().copied().collect(),
        able: &[A, B].map(str::to_owned).into(),
        loops: &[],
    };
    tools.check(&user, component)
}

fn other(tool: &str, number: usize) -> Result<(), ToolFault> {
    Err(ToolFault::Other {
        tool: tool.to_owned(),
        step: format!("step {number}"),
    })
}

fn detached(number: usize) -> Result<(), ToolFault> {
    let step = format!("step {number}");
    Err(ToolFault::Detached { step })
}

#[test]
fn the_last_tool_before_a_step_does_it_until_it_is_detached() {
    let mut tools = AttachedTools::default();
    assert_eq!(check(&tools, By::Any, &[], B), Ok(()));
    let none = check(&tools, By::AttachedTool, &[], B);
    assert_eq!(none, Err(ToolFault::NoTool));

    tools.attach(CHANGER, Some(A.to_owned()), step(0));
    for by in [By::Any, By::AttachedTool] {
        assert_eq!(check(&tools, by, &[0], A), Ok(()));
        assert_eq!(check(&tools, by, &[0], B), other(A, 0));
    }
    assert_eq!(check(&tools, By::SameAs(3), &[0], B), Ok(()));
    let unordered = check(&tools, By::Any, &[], B);
    assert_eq!(unordered, Ok(()), "the tool is attached by another branch");

    tools.attach(CHANGER, Some(B.to_owned()), step(1));
    assert_eq!(check(&tools, By::Any, &[0, 1], B), Ok(()));
    assert_eq!(check(&tools, By::SameAs(0), &[0, 1], A), detached(1));

    tools.detach(CHANGER, &step(2));
    assert_eq!(check(&tools, By::Any, &[0, 1, 2], B), detached(2));
    assert_eq!(check(&tools, By::Any, &[0, 1, 2], "urn:third"), Ok(()));
    let none = check(&tools, By::AttachedTool, &[0, 1, 2], "urn:third");
    assert!(matches!(none, Err(ToolFault::NoneLeft { .. })), "{none:?}");
    // It is attached again.
    tools.attach(CHANGER, Some(B.to_owned()), step(3));
    assert_eq!(check(&tools, By::AttachedTool, &[3], B), Ok(()));
}

#[test]
fn a_tool_of_another_changer_stays_attached() {
    let mut tools = AttachedTools::default();
    tools.attach(CHANGER, Some(A.to_owned()), step(0));
    tools.attach(SECOND, Some(B.to_owned()), step(1));
    assert_eq!(check(&tools, By::Any, &[0, 1], A), other(B, 1));
    assert_eq!((tools.at(CHANGER), tools.at(SECOND)), (Some(A), Some(B)));
    tools.detach(SECOND, &step(2));
    assert_eq!(check(&tools, By::Any, &[0, 1, 2], A), Ok(()));
}

#[test]
fn after_a_step_that_failed_neither_tool_is_used() {
    let mut tools = AttachedTools::default();
    tools.attach(CHANGER, Some(A.to_owned()), step(0));
    tools.lose(CHANGER, Some(B.to_owned()), step(1));
    let step = || "step 1".to_owned();
    for tool in [A, B] {
        let uncertain = Err(ToolFault::Uncertain { step: step() });
        assert_eq!(check(&tools, By::Any, &[0, 1], tool), uncertain);
    }
    assert_eq!(check(&tools, By::Any, &[0, 1], "urn:robot"), Ok(()));
    let unknown = Err(ToolFault::Unknown { step: step() });
    assert_eq!(
        check(&tools, By::AttachedTool, &[0, 1], "urn:third"),
        unknown
    );
}

#[test]
fn a_tool_of_an_earlier_round_is_attached_before_all_steps_of_the_loop() {
    let mut tools = AttachedTools::default();
    tools.attach(CHANGER, Some(A.to_owned()), step(5));
    let one = Loop {
        steps: [4, 5].into(),
        again: Vec::new(),
        rounds: 2,
    };
    let user = ToolUser {
        number: 4,
        by: By::AttachedTool,
        behind: &BTreeSet::new(),
        able: &[A.to_owned()].into(),
        loops: std::slice::from_ref(&one),
    };
    assert_eq!(tools.check(&user, A), Err(ToolFault::NoTool));
    tools.repeat(&one.steps);
    assert_eq!(tools.check(&user, A), Ok(()));
}

fn shown(attached: &[(&str, Option<&str>)]) -> ShownTools {
    let attached = attached.iter().copied();
    ShownTools {
        attached: attached
            .map(|(changer, tool)| (changer.to_owned(), tool.map(str::to_owned)))
            .collect(),
        tools: [A, B].map(str::to_owned).into(),
    }
}

#[test]
fn the_tools_before_the_run_come_before_all_steps() {
    let mut tools = AttachedTools::default();
    tools.observe(&shown(&[(CHANGER, Some(A))]));
    for by in [By::Any, By::AttachedTool] {
        assert_eq!(check(&tools, by, &[], A), Ok(()));
        assert_eq!(check(&tools, by, &[], B), Err(ToolFault::NotAttached));
    }
    assert_eq!(check(&tools, By::Any, &[], "urn:third"), Ok(()));
    let tool = A.to_owned();
    let third = check(&tools, By::AttachedTool, &[], "urn:third");
    assert_eq!(third, Err(ToolFault::OtherBefore { tool }));
    assert_eq!(tools.at(CHANGER), Some(A));
    // A step attaches another tool, and the changer is read again.
    tools.attach(CHANGER, Some(B.to_owned()), step(0));
    tools.observe(&shown(&[(CHANGER, Some(A))]));
    assert_eq!(check(&tools, By::Any, &[0], A), detached(0));
    assert_eq!(check(&tools, By::AttachedTool, &[0], B), Ok(()));
}

#[test]
fn a_tool_from_before_the_run_is_not_used_after_a_step_detaches_it() {
    let mut tools = AttachedTools::default();
    tools.observe(&shown(&[(CHANGER, Some(A))]));
    tools.detach(CHANGER, &step(0));
    tools.observe(&shown(&[(CHANGER, Some(A))]));
    assert_eq!(check(&tools, By::Any, &[0], A), detached(0));
    assert_eq!(tools.at(CHANGER), None);
}

#[test]
fn no_tool_is_used_while_a_changer_does_not_show_its_tool() {
    let mut tools = AttachedTools::default();
    tools.observe(&shown(&[(CHANGER, None)]));
    let changer = || CHANGER.to_owned();
    let hidden = Err(ToolFault::NotShown { changer: changer() });
    assert_eq!(check(&tools, By::Any, &[], A), hidden);
    let third = check(&tools, By::AttachedTool, &[], "urn:third");
    assert_eq!(third, Err(ToolFault::NoToolShown { changer: changer() }));
    // A step attaches the tool with that changer.
    let mut attached = tools.clone();
    attached.attach(CHANGER, Some(A.to_owned()), step(0));
    assert_eq!(check(&attached, By::AttachedTool, &[0], A), Ok(()));
    // It shows its tool, and does not respond afterwards.
    tools.observe(&shown(&[(CHANGER, Some(A))]));
    for attached in [&[(CHANGER, None)][..], &[]] {
        tools.observe(&shown(attached));
        assert_eq!(check(&tools, By::AttachedTool, &[], A), Ok(()));
    }
    tools.observe(&shown(&[(CHANGER, Some(""))]));
    assert_eq!(check(&tools, By::Any, &[], A), Err(ToolFault::NotAttached));
}

fn planned(number: usize, work: ToolWork, tool: Option<&str>) -> PlannedToolStep {
    PlannedToolStep {
        work,
        changers: vec![CHANGER.to_owned()],
        same_as: None,
        tool: tool.map(str::to_owned),
        step: step(number),
        may_be_skipped: false,
    }
}

fn user<'a>(behind: &'a BTreeSet<usize>, able: &'a BTreeSet<String>) -> ToolUser<'a> {
    ToolUser {
        number: 9,
        by: By::AttachedTool,
        behind,
        able,
        loops: &[],
    }
}

#[test]
fn a_step_that_may_be_skipped_joins_both_cases() {
    let (behind, able) = ([0, 1].into(), [A, B].map(str::to_owned).into());
    let user = user(&behind, &able);
    let mut possible = PossibleTools::known(&AttachedTools::default());
    possible.go(&[&planned(0, ToolWork::Attach, Some(A))]);
    assert_eq!(possible.wrong(&user, A), (0, None));
    let maybe = PlannedToolStep {
        may_be_skipped: true,
        ..planned(1, ToolWork::Attach, Some(B))
    };
    possible.go(&[&maybe]);
    for tool in [A, B] {
        assert_eq!(possible.wrong(&user, tool).0, 1, "{tool}");
        assert_eq!(possible.allows(&user, tool), Ok(()));
    }
    assert!(possible.allows(&user, "urn:third").is_err());
    // A certain step leaves one case of the attached tool.
    possible.go(&[&planned(1, ToolWork::Attach, Some(B))]);
    assert_eq!(possible.wrong(&user, B).0, 0);
    assert!(possible.allows(&user, A).is_err());
}

#[test]
fn a_tool_that_a_result_names_may_be_any() {
    let (behind, able) = ([0, 1].into(), [A, B].map(str::to_owned).into());
    let mut possible = PossibleTools::known(&AttachedTools::default());
    possible.go(&[
        &planned(0, ToolWork::Attach, Some(A)),
        &planned(1, ToolWork::Attach, None),
    ]);
    for tool in [A, B, "urn:third"] {
        assert_eq!(possible.allows(&user(&behind, &able), tool), Ok(()));
    }
    possible.go(&[&planned(1, ToolWork::Detach, None)]);
    assert!(possible.allows(&user(&behind, &able), A).is_err());
}

#[test]
fn the_rounds_of_a_loop_join_its_end_with_its_start() {
    let (behind, able) = ([0, 1].into(), [A, B].map(str::to_owned).into());
    let user = user(&behind, &able);
    let maybe = |number, tool| PlannedToolStep {
        may_be_skipped: true,
        ..planned(number, ToolWork::Attach, Some(tool))
    };
    let body = [&maybe(0, A), &maybe(1, B)];
    let mut possible = PossibleTools::known(&AttachedTools::default());
    possible.go(&body);
    let wrong = |possible: &PossibleTools| possible.wrong(&user, A).0;
    let once = wrong(&possible);
    possible.repeat(&body, &[0, 1].into());
    assert!(wrong(&possible) > once, "A after B is detached in round 2");
    assert_eq!(possible.allows(&user, A), Ok(()));
    let known = possible.clone();
    possible.repeat(&body, &[0, 1].into());
    assert_eq!(possible, known, "no new case");
}

#[test]
fn more_cases_than_are_kept_are_decided_when_the_step_begins() {
    let tools: Vec<String> = (0..PossibleTools::MOST_CASES)
        .map(|one| format!("urn:{one}"))
        .collect();
    let mut possible = PossibleTools::known(&AttachedTools::default());
    for (number, tool) in tools.iter().enumerate() {
        let changers = vec![format!("urn:changer:{number}")];
        possible.go(&[&PlannedToolStep {
            changers,
            may_be_skipped: true,
            ..planned(number, ToolWork::Attach, Some(tool))
        }]);
    }
    assert_eq!(possible.cases.len(), PossibleTools::MOST_CASES);
    let (behind, able) = ((0..100).collect(), BTreeSet::new());
    assert_eq!(possible.allows(&user(&behind, &able), "urn:third"), Ok(()));
}

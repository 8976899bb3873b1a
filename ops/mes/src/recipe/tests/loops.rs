//! Recipes whose flow returns to an earlier step.

use super::*;
use crate::process::Loop;

/// A recipe that doses and stirs until the level is high enough.
fn batchml(transitions: &str) -> String {
    let link = |id: &str, from: (&str, &str), to: &[(&str, &str)]| {
        let to: String = to
            .iter()
            .map(|(value, kind)| {
                format!("<ToID><ToIDValue>{value}</ToIDValue><ToType>{kind}</ToType></ToID>")
            })
            .collect();
        format!(
            "<Link><ID>{id}</ID><FromID><FromIDValue>{}</FromIDValue><FromType>{}</FromType></FromID>{to}\
             <LinkType>ControlLink</LinkType></Link>",
            from.0, from.1
        )
    };
    let links = [
        link("L1", ("Dose", "Step"), &[("Dosed", "Transition")]),
        link("L2", ("Dosed", "Transition"), &[("Stir", "Step")]),
        link(
            "L3",
            ("Stir", "Step"),
            &[("again", "Transition"), ("on", "Transition")],
        ),
        link("L4", ("again", "Transition"), &[("Dose", "Step")]),
        link("L5", ("on", "Transition"), &[("Empty", "Step")]),
    ]
    .concat();
    let steps: String = ["Dose", "Stir", "Empty"]
        .iter()
        .map(|id| format!("<Step><ID>{id}</ID><RecipeElementID>e{id}</RecipeElementID></Step>"))
        .collect();
    let elements: String = ["Dose", "Stir", "Empty"]
        .iter()
        .map(|id| {
            format!("<RecipeElement><ID>e{id}</ID><RecipeElementType>Phase</RecipeElementType><EquipmentRequirement><ID>urn:c:{id}</ID></EquipmentRequirement></RecipeElement>")
        })
        .collect();
    format!(
        "<BatchInformation xmlns=\"http://www.mesa.org/xml/B2MML\"><MasterRecipe><ID>r</ID><ProcedureLogic>{links}{steps}\
         <Transition><ID>Dosed</ID><Condition>True</Condition></Transition>{transitions}</ProcedureLogic>{elements}</MasterRecipe></BatchInformation>"
    )
}

const AGAIN: &str = "<Transition><ID>again</ID><Condition>Stir.Level &lt; 0.5</Condition></Transition>\
                     <Transition><ID>on</ID><Condition>True</Condition></Transition>";

fn low(is_negated: bool) -> StepCondition {
    StepCondition {
        step: 1,
        test: Test::Result {
            name: "Level".to_owned(),
            compare: Compare::Less,
            value: json!(0.5),
        },
        is_negated,
    }
}

#[test]
fn a_transition_to_an_earlier_step_is_a_loop() {
    let text = batchml(AGAIN);
    let recipe = read(&text, &Names::new()).unwrap();
    let process = &recipe.processes[0];
    assert_eq!(names(&process.steps), ["Dose", "Stir", "Empty"]);
    let expected = Loop {
        steps: [0, 1].into(),
        again: vec![vec![low(false)]],
        rounds: Loop::USUAL_ROUNDS,
    };
    assert_eq!(process.loops, [expected]);
    // The step behind the loop waits for all steps of it, and comes when no other round does.
    assert_eq!(process.steps[2].waits_for(2)[..2], [0, 1]);
    assert_eq!(process.steps[2].when, [[low(true)]]);
    assert_eq!(process.steps[0].when, Vec::<Vec<StepCondition>>::new());
}

#[test]
fn a_bpmn_task_is_tried_again_by_its_boundary_event_or_by_a_gateway() {
    let text = r#"<definitions xmlns="http://www.omg.org/spec/BPMN/20100524/MODEL"><process id="p">
        <startEvent id="s"/><sequenceFlow id="f0" sourceRef="s" targetRef="weigh"/>
        <serviceTask id="weigh" implementation="urn:c:weigh"/>
        <boundaryEvent id="failed" attachedToRef="weigh"><errorEventDefinition/></boundaryEvent>
        <sequenceFlow id="f1" sourceRef="failed" targetRef="weigh"/>
        <sequenceFlow id="f2" sourceRef="weigh" targetRef="dose"/>
        <serviceTask id="dose" implementation="urn:c:dose"/>
        <sequenceFlow id="f3" sourceRef="dose" targetRef="x"/>
        <exclusiveGateway id="x" default="f5"/>
        <sequenceFlow id="f4" sourceRef="x" targetRef="weigh"><conditionExpression>${dose.Level &lt; 0.5}</conditionExpression></sequenceFlow>
        <sequenceFlow id="f5" sourceRef="x" targetRef="e"/><endEvent id="e"/></process></definitions>"#;
    let recipe = read(text, &Names::new()).unwrap();
    let process = &recipe.processes[0];
    // Both return to one task: they are one loop.
    let [one] = process.loops.as_slice() else {
        panic!("{process:?}")
    };
    assert_eq!(one.steps, [0, 1].into());
    let failed = StepCondition {
        step: 0,
        test: Test::Ended(BadEnd::Failed),
        is_negated: false,
    };
    assert!(one.again.contains(&vec![failed]), "{one:?}");
    assert_eq!(one.again.len(), 2);
    assert!(process.handles(0, BadEnd::Failed));
}

#[test]
fn a_loop_without_a_clear_end_is_refused() {
    for (from, to, why) in [
        (
            r#"<sequenceFlow id="f5" sourceRef="x" targetRef="e"/>"#,
            r#"<sequenceFlow id="f5" sourceRef="x" targetRef="dose"/>"#,
            "no way leads out of the loop that returns to `dose`",
        ),
        (
            r#"<sequenceFlow id="f3" sourceRef="dose" targetRef="x"/>"#,
            r#"<sequenceFlow id="f3" sourceRef="dose" targetRef="x"/><sequenceFlow id="f6" sourceRef="dose" targetRef="z"/><endEvent id="z"/>"#,
            "the flow leaves the loop that returns to `dose` while it returns",
        ),
        (
            "${dose.Level",
            "${e.Level",
            "returns to `dose` by a condition about `e`, which may not be over then",
        ),
    ] {
        let text = r#"<definitions xmlns="http://www.omg.org/spec/BPMN/20100524/MODEL"><process id="p">
            <startEvent id="s"/><sequenceFlow id="f0" sourceRef="s" targetRef="dose"/>
            <serviceTask id="dose" implementation="urn:c:dose"/>
            <sequenceFlow id="f3" sourceRef="dose" targetRef="x"/>
            <exclusiveGateway id="x" default="f5"/>
            <sequenceFlow id="f4" sourceRef="x" targetRef="dose"><conditionExpression>${dose.Level &lt; 0.5}</conditionExpression></sequenceFlow>
            <sequenceFlow id="f5" sourceRef="x" targetRef="e"/>
            <serviceTask id="e" implementation="urn:c:end"/></process></definitions>"#;
        assert!(text.contains(from), "{from}");
        assert!(read(text, &Names::new()).is_ok());
        let errors = errors(&text.replacen(from, to, 1));
        let is_there = errors.iter().any(|error| error.contains(why));
        assert!(is_there, "{why}: {errors:?}");
    }
}

/// Returns the loops of a process in the graph, or the reason why it cannot run.
fn in_graph(turtle: &str) -> Result<Vec<Loop>, String> {
    let knowledge = knowledge::Knowledge::new().unwrap();
    let source = knowledge::KnowledgeSource::new(knowledge::SourceKind::File, "p.ttl");
    knowledge.replace_turtle(&source, turtle, 1).unwrap();
    let mut read = crate::read_process::Processes::read(&knowledge).unwrap();
    match read.all.pop() {
        Some(process) => Ok(process.loops),
        None => Err(read.faults.into_values().next().unwrap().to_string()),
    }
}

/// A process of three steps, with a loop over two of them.
const OF_THREE: &str = "@prefix css: <http://www.w3id.org/hsu-aut/css#> . @prefix cask: <http://www.w3id.org/hsu-aut/cask#> .
        @prefix ua: <urn:ua-bridge:plant#> .
        <urn:p> a css:Process ; ua:hasStep <urn:p/1> , <urn:p/2> , <urn:p/3> ; ua:hasLoop <urn:p/l> .
        <urn:p/1> ua:position 1 ; css:requiresCapability [ a cask:RequiredCapability , <urn:c:1> ] .
        <urn:p/2> ua:position 2 ; css:requiresCapability [ a cask:RequiredCapability , <urn:c:2> ] .
        <urn:p/3> ua:position 3 ; css:requiresCapability [ a cask:RequiredCapability , <urn:c:3> ] .
        <urn:p/l> ua:repeats <urn:p/1> , <urn:p/2> ; ua:rounds 7 ;
            ua:when [ ua:condition [ ua:resultOf <urn:p/2> ; ua:endsAs \"failed\" ] ] .";

#[test]
fn loops_come_back_from_the_graph_and_faulty_ones_have_a_reason() {
    let text = batchml(AGAIN);
    let process = read(&text, &Names::new()).unwrap().processes.remove(0);
    let knowledge = knowledge::Knowledge::new().unwrap();
    let source = knowledge::KnowledgeSource::new(knowledge::SourceKind::Process, "a recipe");
    let triples = process.triples(&|_| None);
    knowledge.replace(&source, &triples, 1).unwrap();
    let read = crate::read_process::Processes::read(&knowledge).unwrap();
    assert_eq!(read.faults, BTreeMap::new());
    assert_eq!(read.all, [process]);

    let turtle = OF_THREE;
    let loops = in_graph(turtle).unwrap();
    assert_eq!((loops[0].rounds, &loops[0].steps), (7, &[0, 1].into()));
    let only = "ua:repeats <urn:p/2> ;";
    let turtle_of_two = turtle.replacen("ua:repeats <urn:p/1> , <urn:p/2> ;", only, 1);
    let and_first = "[ ua:condition [ ua:resultOf <urn:p/1> ; ua:endsAs \"failed\" ] , [";
    let with_both = turtle_of_two.replacen("[ ua:condition [", and_first, 1);
    // A step for which the loop waits may be named beside one of its own.
    assert_eq!(in_graph(&with_both).unwrap()[0].again[0].len(), 2);
    let before = turtle_of_two.replacen("ua:resultOf <urn:p/2>", "ua:resultOf <urn:p/1>", 1);
    let why = in_graph(&before).unwrap_err();
    let expected = "has a ua:when about urn:p/1 without a step of the loop";
    assert!(why.contains(expected), "{why}");
    for (from, to, why) in [
        ("ua:rounds 7", "ua:rounds 0", "not from 1 to 500: 0"),
        (
            "ua:repeats <urn:p/1> , <urn:p/2>",
            "ua:repeats <urn:p/9>",
            "repeats urn:p/9, which is no step",
        ),
        (
            "ua:repeats <urn:p/1> , <urn:p/2> ;",
            "",
            "has no ua:repeats",
        ),
        (
            "ua:when [ ua:condition [ ua:resultOf <urn:p/2> ; ua:endsAs \"failed\" ] ]",
            "ua:position 1",
            "has no ua:when",
        ),
        (
            "ua:repeats <urn:p/1> , <urn:p/2>",
            "ua:repeats <urn:p/1> , <urn:p/3>",
            "waits for the step urn:p/2, which waits for the end of the loop",
        ),
        (
            "ua:hasLoop <urn:p/l> .",
            "ua:hasLoop <urn:p/l> , <urn:p/m> . <urn:p/m> ua:repeats <urn:p/2> , <urn:p/3> ;
                ua:when [ ua:condition [ ua:resultOf <urn:p/3> ; ua:endsAs \"failed\" ] ] .",
            "shares steps with another loop",
        ),
        (
            "ua:resultOf <urn:p/2>",
            "ua:resultOf <urn:p/3>",
            "the loop urn:p/l has a condition about the step urn:p/3, which may not be over",
        ),
    ] {
        assert!(turtle.contains(from), "{from}");
        let fault = in_graph(&turtle.replacen(from, to, 1)).unwrap_err();
        assert!(fault.contains(why), "{why}: {fault}");
    }
}

#[test]
fn a_loop_decides_by_all_steps_of_a_loop_before_it() {
    // A step that waits for a step of another loop begins when that whole loop is left.
    let parallel = OF_THREE
        .replacen("ua:position 2", "ua:position 2 ; ua:after <urn:p>", 1)
        .replacen("ua:position 3", "ua:position 3 ; ua:after <urn:p/1>", 1);
    for iri in ["<urn:p/a>", "<urn:p/z>"] {
        let also = format!(
            "ua:hasLoop <urn:p/l> , {iri} . {iri} ua:repeats <urn:p/3> ; ua:when [
                ua:condition [ ua:resultOf <urn:p/3> ; ua:endsAs \"failed\" ] ,
                    [ ua:resultOf <urn:p/2> ; ua:endsAs \"failed\" ] ] ."
        );
        let legal = parallel.replacen("ua:hasLoop <urn:p/l> .", &also, 1);
        assert_eq!(in_graph(&legal).map(|loops| loops.len()), Ok(2), "{iri}");
        let apart = legal.replacen(
            "<urn:p/1> , <urn:p/2> ; ua:rounds",
            "<urn:p/1> ; ua:rounds",
            1,
        );
        let of_two = "ua:when [ ua:condition [ ua:resultOf <urn:p/2>";
        assert!(apart.contains(of_two));
        let apart = apart.replacen(of_two, &of_two.replace("p/2", "p/1"), 1);
        let why = in_graph(&apart).unwrap_err();
        let expected = "has a condition about the step urn:p/2, which may not be over";
        assert!(why.contains(expected), "{why}");
    }
}

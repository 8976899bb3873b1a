mod loops;

use std::time::Duration;

use serde_json::json;

use super::*;
use crate::process::{BadEnd, Compare, ProcessStep, StepCondition, Test};

const BATCH: &str = include_str!("../../../../examples/plant/batch.xml");
const BPMN: &str = include_str!("../../../../examples/plant/batch.bpmn");

fn steps(text: &str) -> Vec<ProcessStep> {
    let recipe = read(text, &Names::new()).unwrap();
    let [process] = recipe.processes.as_slice() else {
        panic!("{recipe:?}")
    };
    process.steps.clone()
}

fn names(steps: &[ProcessStep]) -> Vec<&str> {
    steps.iter().map(|step| step.name.as_str()).collect()
}

fn errors(text: &str) -> Vec<String> {
    let errors = read(text, &Names::new()).unwrap_err();
    errors.iter().map(ToString::to_string).collect()
}

/// Returns the number of the line that contains a text.
fn line_with(text: &str, wanted: &str) -> usize {
    text.lines().position(|line| line.contains(wanted)).unwrap() + 1
}

#[test]
fn a_master_recipe_is_a_process_with_the_order_of_its_procedure_logic() {
    let steps = steps(BATCH);
    assert_eq!(
        names(&steps),
        ["dose", "stir", "heat the reactor", "cool the reactor"]
    );
    let waits: Vec<_> = (0..)
        .zip(&steps)
        .map(|(number, step)| step.waits_for(number))
        .collect();
    assert_eq!(waits, [vec![], vec![0], vec![], vec![1, 2]]);
    let need = |step: &ProcessStep| step.needs.first().cloned().unwrap();
    assert_eq!(need(&steps[0]).capability, None, "`Dosing:Fill` is no IRI");
    assert_eq!(
        need(&steps[0]).skill_type.unwrap().to_string(),
        "nsu=urn:ua-bridge:mtp:dosing;Dosing-FillSkillType"
    );
    assert_eq!(
        need(&steps[2]).capability.as_deref(),
        Some("urn:example:capability:react")
    );
    let amount = &steps[0].parameters[0];
    assert_eq!(
        (amount.name.as_str(), &amount.value, amount.unit.as_deref()),
        ("Amount", &json!(2500), Some("ml")),
        "the reference leads to the formula"
    );
}

#[test]
fn every_element_that_is_left_out_has_its_line() {
    let with = BATCH
        .replacen("<Formula>", "<Header><ProductID>p</ProductID></Header>\n<Formula>", 1)
        .replacen(
            "<EquipmentRequirement><ID>urn:example:capability:react</ID>",
            "<EquipmentRequirement><ID>urn:example:capability:react</ID>\n<Constraint><Condition>Material == H2O</Condition></Constraint>",
            1,
        );
    let recipe = read(&with, &Names::new()).unwrap();
    let notes: Vec<_> = recipe.notes.iter().map(ToString::to_string).collect();
    let header = line_with(&with, "<Header>");
    let constraint = line_with(&with, "<Constraint>");
    assert_eq!(
        notes,
        [
            format!("line {header}: Header of MasterRecipe is left out"),
            format!("line {constraint}: the constraint `Material == H2O` is not checked"),
        ]
    );
}

#[test]
fn a_recipe_that_no_process_can_have_is_refused_with_the_lines() {
    for (from, to, line, why) in [
        (
            "<ActualEquipmentID>mixing</ActualEquipmentID>",
            "",
            "<ID>Mixing:Stir</ID>",
            "nothing says which skill does `Mixing:Stir`",
        ),
        (
            "<Condition>Step Dose is Completed</Condition>",
            "<Condition>Dose.Level > 3</Condition>",
            "<ID>Dosed</ID><Condition>",
            "waits until a value has changed",
        ),
        (
            "<RecipeElementID>Dosing:Fill<",
            "<RecipeElementID>Dosing:Fil<",
            "<RecipeElementID>Dosing:Fil<",
            "the recipe element `Dosing:Fil`, which is unknown",
        ),
        (
            "<ValueString>StirringTime<",
            "<ValueString>StiringTime<",
            "<ValueString>StiringTime<",
            "refers to `StiringTime`",
        ),
        (
            "<LinkType>ParallelConvergent<",
            "<LinkType>TransferLink<",
            "<ID>All</ID>",
            "links of control only",
        ),
        (
            "<DataInterpretation>Constant</DataInterpretation><DataType>double</DataType><UnitOfMeasure>°C<",
            "<DataInterpretation>Equation</DataInterpretation><DataType>double</DataType><UnitOfMeasure>°C<",
            "<DataInterpretation>Equation<",
            "the DataInterpretation `Equation`",
        ),
        (
            "<FromIDValue>Begin<",
            "<FromIDValue>Beginn<",
            "<FromIDValue>Beginn<",
            "the Step `Beginn`, which is unknown",
        ),
    ] {
        assert!(BATCH.contains(from), "{from}");
        let text = BATCH.replacen(from, to, 1);
        let errors = errors(&text);
        let near = line_with(&text, line);
        let is_there = errors.iter().any(|error| {
            let at = error
                .split_once(": ")
                .unwrap()
                .0
                .trim_start_matches("line ");
            let at: usize = at.parse().unwrap();
            error.contains(why) && at.abs_diff(near) <= 1
        });
        assert!(is_there, "{why} near {near}: {errors:?}");
    }
}

#[test]
fn branches_of_a_recipe_have_the_conditions_of_their_transitions() {
    let text = r#"<BatchInformation xmlns="http://www.mesa.org/xml/B2MML"><MasterRecipe><ID>r</ID><ProcedureLogic>
        <Link><ID>L1</ID><FromID><FromIDValue>A</FromIDValue><FromType>Step</FromType></FromID>
          <ToID><ToIDValue>low</ToIDValue><ToType>Transition</ToType></ToID><ToID><ToIDValue>else</ToIDValue><ToType>Transition</ToType></ToID><LinkType>SerialDivergent</LinkType></Link>
        <Link><ID>L2</ID><FromID><FromIDValue>low</FromIDValue><FromType>Transition</FromType></FromID><ToID><ToIDValue>B</ToIDValue><ToType>Step</ToType></ToID><LinkType>ControlLink</LinkType></Link>
        <Link><ID>L3</ID><FromID><FromIDValue>else</FromIDValue><FromType>Transition</FromType></FromID><ToID><ToIDValue>C</ToIDValue><ToType>Step</ToType></ToID><LinkType>ControlLink</LinkType></Link>
        <Step><ID>A</ID><RecipeElementID>a</RecipeElementID></Step><Step><ID>B</ID><RecipeElementID>b</RecipeElementID></Step><Step><ID>C</ID><RecipeElementID>c</RecipeElementID></Step>
        <Transition><ID>low</ID><Condition>A.Level &lt; 0.5</Condition></Transition><Transition><ID>else</ID><Condition>True</Condition></Transition>
      </ProcedureLogic>
      <RecipeElement><ID>a</ID><RecipeElementType>Phase</RecipeElementType></RecipeElement>
      <RecipeElement><ID>b</ID><RecipeElementType>Phase</RecipeElementType></RecipeElement>
      <RecipeElement><ID>c</ID><RecipeElementType>Phase</RecipeElementType></RecipeElement>
    </MasterRecipe></BatchInformation>"#;
    let named = ["a", "b", "c"].map(|name| (name.to_owned(), format!("urn:c:{name}")));
    let recipe = read(text, &Names::from(named.clone())).unwrap();
    let steps = &recipe.processes[0].steps;
    let low = |is_negated| StepCondition {
        step: 0,
        test: Test::Result {
            name: "Level".to_owned(),
            compare: Compare::Less,
            value: json!(0.5),
        },
        is_negated,
    };
    assert_eq!(steps[1].when, [[low(false)]]);
    assert_eq!(steps[2].when, [[low(true)]]);
    assert_eq!(steps[2].after.as_deref(), Some(&[0][..]));
    let no_else = text.replace("<Condition>True<", "<Condition>A.Level > 3<");
    let errors = read(&no_else, &Names::from(named)).unwrap_err();
    assert!(
        errors[0]
            .what
            .contains("only the last has the condition True"),
        "{errors:?}"
    );
}

#[test]
fn a_bpmn_process_has_parallel_branches_and_handlers_of_bad_ends() {
    let steps = steps(BPMN);
    assert_eq!(
        names(&steps),
        [
            "dose",
            "heat the reactor",
            "rinse",
            "stir",
            "empty the mixer"
        ]
    );
    let ended = |step, end, is_negated| StepCondition {
        step,
        test: Test::Ended(end),
        is_negated,
    };
    let waits: Vec<_> = (0..)
        .zip(&steps)
        .map(|(number, step)| step.waits_for(number))
        .collect();
    let none: &[Vec<usize>] = &[vec![], vec![]];
    assert_eq!(waits[..2], *none, "both begin at once");
    assert_eq!(steps[2].when, [[ended(0, BadEnd::Failed, false)]]);
    // The branches meet again: the step behind them runs in every case.
    assert_eq!(steps[3].when, Vec::<Vec<StepCondition>>::new());
    assert_eq!(steps[3].after.as_deref(), Some(&[0, 1, 2][..]));
    assert_eq!(steps[3].within, Some(Duration::from_secs(20)));
    assert_eq!(steps[4].when, [[ended(3, BadEnd::TimedOut, false)]]);
    let amount = &steps[0].parameters[0];
    assert_eq!(
        (&amount.value, amount.unit.as_deref()),
        (&json!(2.5), Some("L"))
    );
}

#[test]
fn everything_unsupported_in_bpmn_is_refused_by_name_with_its_line() {
    for (from, to, why) in [
        (
            r#"<bpmn:serviceTask id="empty" name="empty the mixer" implementation="nsu=urn:ua-bridge:mtp:mixing;Mixing-EmptySkillType"/>"#,
            r#"<bpmn:userTask id="empty" name="empty the mixer"/>"#,
            "userTask `empty the mixer` is not supported",
        ),
        (
            r#"<bpmn:endEvent id="end"/>"#,
            r#"<bpmn:endEvent id="end"><bpmn:terminateEventDefinition/></bpmn:endEvent>"#,
            "the endEvent `end` with terminateEventDefinition",
        ),
        (
            r#"<bpmn:boundaryEvent id="late" attachedToRef="stir">"#,
            r#"<bpmn:boundaryEvent id="late" attachedToRef="stir" cancelActivity="false">"#,
            "does not end its task",
        ),
        ("PT20S", "R3/PT20S", "no timeDuration"),
        (
            r#"<bpmn:exclusiveGateway id="meet"/>"#,
            r#"<bpmn:inclusiveGateway id="meet"/>"#,
            "inclusiveGateway `meet` is not supported",
        ),
        (
            r#"<bpmn:exclusiveGateway id="meet"/>"#,
            r#"<bpmn:parallelGateway id="meet"/>"#,
            "`meet` waits for branches that do not run in every case",
        ),
        (
            r#"<bpmn:parallelGateway id="all"/>"#,
            r#"<bpmn:exclusiveGateway id="all"/>"#,
            "branches that run in parallel meet at `all`",
        ),
        (
            r#"targetRef="end"/>
    <bpmn:sequenceFlow id="f12""#,
            r#"targetRef="dose"/>
    <bpmn:sequenceFlow id="f12""#,
            "the loop that returns to `dose` is entered at another place too",
        ),
        (
            r#"implementation="urn:example:capability:stir""#,
            "implementation=\"##WebService\"",
            "nothing says which skill does the task `stir`",
        ),
    ] {
        assert!(BPMN.contains(from), "{from}");
        let errors = errors(&BPMN.replacen(from, to, 1));
        let is_there = errors.iter().any(|error| error.contains(why));
        assert!(is_there, "{why}: {errors:?}");
    }
}

#[test]
fn an_exclusive_gateway_needs_a_default_flow_and_results_need_their_step() {
    let of = |default: &str, amount: &str| {
        format!(
            r#"<definitions xmlns="http://www.omg.org/spec/BPMN/20100524/MODEL"><process id="p">
            <startEvent id="s"/><sequenceFlow id="f0" sourceRef="s" targetRef="weigh"/>
            <serviceTask id="weigh" implementation="urn:c:weigh"/><sequenceFlow id="f1" sourceRef="weigh" targetRef="x"/>
            <exclusiveGateway id="x" {default}/>
            <sequenceFlow id="f2" sourceRef="x" targetRef="more"><conditionExpression>${{weigh.Mass &lt; 2}}</conditionExpression></sequenceFlow>
            <serviceTask id="more" implementation="urn:c:dose"><dataInputAssociation><assignment><from>{amount}</from><to>Amount</to></assignment></dataInputAssociation></serviceTask>
            <sequenceFlow id="f3" sourceRef="x" targetRef="e"/><sequenceFlow id="f4" sourceRef="more" targetRef="e"/>
            <serviceTask id="e" implementation="urn:c:end"/></process></definitions>"#
        )
    };
    let steps = steps(&of(r#"default="f3""#, "${weigh.Rest}"));
    assert!(!steps[1].when[0][0].is_negated);
    assert_eq!(steps[1].parameters[0].result.as_ref().unwrap().step, 0);
    assert!(steps[2].when.is_empty(), "{:?}", steps[2]);
    let both = of("", "1").replace(
        r#"sourceRef="x" targetRef="e"/>"#,
        r#"sourceRef="x" targetRef="e"><conditionExpression>weigh.Mass > 3</conditionExpression></sequenceFlow>"#,
    );
    let no_default = errors(&both);
    assert!(no_default[0].contains("no default flow"), "{no_default:?}");
    // The end needs a result of a task that is skipped in the other branch.
    let skipped = of(r#"default="f3""#, "1").replace(
        r#"<serviceTask id="e" implementation="urn:c:end"/>"#,
        r#"<serviceTask id="e" implementation="urn:c:end"><dataInputAssociation><assignment><from>=more.Left</from><to>A</to></assignment></dataInputAssociation></serviceTask>"#,
    );
    let skipped = errors(&skipped);
    assert!(
        skipped[0].contains("which is not done whenever `e` begins"),
        "{skipped:?}"
    );
}

#[test]
fn recipes_come_back_from_the_graph_as_they_were() {
    for text in [BATCH, BPMN] {
        let recipe = read(text, &Names::new()).unwrap();
        let knowledge = knowledge::Knowledge::new().unwrap();
        let source = knowledge::KnowledgeSource::new(knowledge::SourceKind::Process, "a recipe");
        let triples = recipe.processes[0].triples(&|_| None);
        knowledge.replace(&source, &triples, 1).unwrap();
        let read = crate::read_process::Processes::read(&knowledge).unwrap();
        assert_eq!(read.faults, BTreeMap::new());
        assert_eq!(read.all, recipe.processes);
    }
}

#[test]
fn a_source_is_a_recipe_by_its_namespace() {
    assert!(in_source(BATCH.as_bytes()).unwrap().is_some());
    assert!(in_source(b"<urn:p> a <urn:q> .").unwrap().is_none());
    let sent = json!({ "recipe": BPMN, "names": { "a": "b" } }).to_string();
    let (text, names) = in_source(sent.as_bytes()).unwrap().unwrap();
    assert_eq!(
        (&*text, names.get("a").map(String::as_str)),
        (BPMN, Some("b"))
    );
    assert!(in_source(b"{\"recipes\": 1}").is_err());
}

#[test]
fn a_real_recipe_is_read_with_the_names_that_it_needs() {
    let Some(text) = test_data::read_foreign(
        "mtp/recipol-hc30-siemens/2026-04-26_BatchML_MasterRecipe1_Sol_1.xml",
    ) else {
        return;
    };
    let without = errors(&text);
    assert_eq!(without.len(), 3, "{without:?}");
    let parts = [
        ("001:7b80d138-7b29-4121-8c9a-4c0993fa2c2b", "urn:c:stir"),
        ("002:cbab70ce-6548-44d7-9917-e4d8e23f5bf9", "urn:c:dose"),
        ("003:888136a9-c795-41c2-970c-169fa9852d22", "urn:c:heat"),
        ("001:d9fdadf8-2da5-4a31-baac-71ba5b59da72", "Duration"),
        ("Sekunde", "s"),
        ("Grad Celsius", "°C"),
        ("Prozent", "%"),
    ];
    let named = parts.map(|(name, stands_for)| (name.to_owned(), stands_for.to_owned()));
    let recipe = read(&text, &Names::from(named)).unwrap();
    let steps = &recipe.processes[0].steps;
    let wanted: Vec<_> = steps
        .iter()
        .map(|step| step.needs[0].capability.as_deref())
        .collect();
    assert_eq!(
        wanted,
        [Some("urn:c:stir"), Some("urn:c:dose"), Some("urn:c:heat")]
    );
    assert_eq!(steps[0].parameters[0].name, "Duration");
    assert_eq!(steps[0].parameters[0].unit.as_deref(), Some("s"));
    assert_eq!(steps[2].parameters.len(), 3);
    assert!(
        steps
            .iter()
            .all(|step| step.after.is_none() && step.when.is_empty())
    );
    let unknown = recipe
        .notes
        .iter()
        .any(|note| note.what.contains("the unit `Liter pro Stunde`"));
    assert!(unknown, "{:?}", recipe.notes);
}

#[test]
fn elements_that_multiply_on_each_level_are_refused() {
    use std::fmt::Write as _;

    let mut elements = String::new();
    for level in 0..9 {
        let mut logic = String::new();
        for number in 1..10 {
            write!(
                logic,
                "<Link><ID>L{number}</ID><FromID><FromIDValue>S{}</FromIDValue><FromType>Step</FromType></FromID>\
                 <ToID><ToIDValue>S{number}</ToIDValue><ToType>Step</ToType></ToID><LinkType>ControlLink</LinkType></Link>",
                number - 1
            )
            .unwrap();
        }
        for number in 0..10 {
            write!(
                logic,
                "<Step><ID>S{number}</ID><RecipeElementID>E{}</RecipeElementID></Step>",
                level + 1
            )
            .unwrap();
        }
        let logic = format!("<ProcedureLogic>{logic}</ProcedureLogic>");
        match level {
            0 => elements.push_str(&logic),
            _ => write!(
                elements,
                "<RecipeElement><ID>E{level}</ID>{logic}</RecipeElement>"
            )
            .unwrap(),
        }
    }
    let text = format!(
        "<BatchInformation xmlns=\"http://www.mesa.org/xml/B2MML\"><MasterRecipe><ID>r</ID>{elements}\
         <RecipeElement><ID>E9</ID><Description>urn:c:stir</Description></RecipeElement></MasterRecipe></BatchInformation>"
    );
    let errors = errors(&text);
    assert!(errors[0].contains("more than 4000"), "{errors:?}");
}

#[test]
fn broken_files_end_with_a_line() {
    for (text, why) in [
        ("", "line 1"),
        ("<a/>", "neither of BatchML nor of BPMN"),
        ("<!DOCTYPE a><a/>", "line 1"),
        (&BATCH[..BATCH.len() / 2], "line "),
        (
            "<BatchInformation xmlns=\"http://www.mesa.org/xml/B2MML\"/>",
            "no recipe",
        ),
    ] {
        let errors = errors(text);
        assert!(errors.iter().any(|error| error.contains(why)), "{errors:?}");
    }
}

//! Parameters of steps that are given by queries over the knowledge of products, and queries that
//! are stopped.

use std::fs;
use std::path::Path;
use std::time::Duration;

use serde_json::Value;
use system_tests::{Cell, StartedChild, eventually, peak, program, resident};

use super::{EXAMPLES, SOON, get, list, post, rows, space, start};

/// Grips a part with the force that its data sheet states.
const PROCESSES: &str = "processes:
  - process: urn:grip-part
    steps:
      - step: grip
        needs: {skill: urn:example:capability:grasp}
        parameters:
          Force: {query: 'SELECT ?force { <urn:part> <urn:force> ?force }', query_name: force of the part, unit: kN}
  - process: urn:handle-part
    steps:
      - {step: grip, needs: {skill: 'http://www.hsu-ifa.de/ontologies/VDI2860#Securing'}}
      - {step: move, needs: {skill: 'http://www.w3id.org/hsu-aut/DIN8580#Kleben'}}
";

fn update(cell: &Cell, text: &str) {
    let file = cell.file("update.ru", text);
    let (updated, told) = space(&["source", "update", file.to_str().unwrap()]);
    assert!(updated, "{told}");
}

/// Returns whether the plan of the process is complete, and what is missing.
fn plan() -> (bool, String) {
    let plan = get("/plan/urn:grip-part").unwrap();
    let missing = plan["missing"].as_str().unwrap_or_default().to_owned();
    (plan["complete"] == true, missing)
}

#[test]
fn a_step_takes_its_parameter_from_the_data_of_the_product_or_the_process_does_not_run() {
    let Some(cell) = Cell::with(&[]) else { return };
    let capabilities = Path::new(EXAMPLES).join("capabilities.ttl");
    fs::copy(capabilities, cell.folder().join("capabilities.ttl")).unwrap();
    let _mes = start(
        &cell,
        "ua-mes",
        "mes.yaml",
        &[("processes:\n", PROCESSES)],
        &[],
    );
    let fast = [("400 ms", "50 ms")];
    let _gripper = start(&cell, "ua-component", "parallel-gripper.yaml", &fast, &[]);
    eventually("the gripper is in the graph", SOON, || {
        rows("components")
            .iter()
            .any(|row| row["name"] == "parallel-gripper")
            .then_some(())
    });
    for (force, reason) in [
        ("", "it has no row"),
        ("\"strong\"", "with the unit kN is no number"),
        ("500", "is not from"),
        ("0.01 , 0.02", "it has several rows"),
    ] {
        let insert = match force {
            "" => String::new(),
            force => format!(" INSERT DATA {{ <urn:part> <urn:force> {force} }}"),
        };
        update(
            &cell,
            &format!("DELETE WHERE {{ <urn:part> <urn:force> ?f }} ;{insert}"),
        );
        let (is_complete, missing) = plan();
        assert!(
            !is_complete && missing.contains(reason),
            "{force}: {missing}"
        );
        let named = "Force (query `force of the part`): ";
        assert!(missing.contains(named), "{missing}");
    }
    let (ran, told) = space(&["job", "start", "urn:grip-part", "--wait"]);
    assert!(!ran && told.contains("force of the part"), "{told}");

    let right = "DELETE WHERE { <urn:part> <urn:force> ?f } ;
        INSERT DATA { <urn:part> <urn:force> 0.02 }";
    update(&cell, right);
    assert_eq!(plan(), (true, String::new()));
    let (ran, told) = space(&["job", "start", "urn:grip-part", "--wait"]);
    assert!(ran, "{told}");
    let values = get("/ask/run-values").unwrap();
    let mut all = list(&values, "rows").iter();
    let force = all
        .find(|row| row["name"] == "Force")
        .map(|row| &row["value"]);
    assert_eq!(force.and_then(Value::as_f64), Some(20.0), "{values}");
    are_chosen_by_operations();
}

/// Checks a plan with operations of the taxonomy: the gripper secures, and nothing joins.
fn are_chosen_by_operations() {
    let plan = get("/plan/urn:handle-part").unwrap();
    let steps = list(&plan["plan"], "steps");
    let chosen = |step: usize| {
        steps[step]["needs"][0]["chosen"]
            .as_str()
            .unwrap_or_default()
    };
    assert!(chosen(0).starts_with("urn:example:gripper#"), "{plan}");
    assert_eq!((chosen(1), &plan["complete"]), ("", &Value::Bool(false)));
    let candidates = list(&steps[0]["needs"][0], "candidates").iter();
    let mut why = candidates.filter_map(|one| one["why"].as_str());
    let expected = "which is below http://www.hsu-ifa.de/ontologies/VDI2860#Securing";
    assert!(why.any(|why| why.contains(expected)), "{plan}");
}

/// Returns the number of threads of a program that work on queries.
fn queries_of(process: u32) -> usize {
    let threads = fs::read_dir(format!("/proc/{process}/task")).unwrap();
    let names =
        threads.filter_map(|thread| fs::read_to_string(thread.ok()?.path().join("comm")).ok());
    names.filter(|name| name.trim() == "sparql").count()
}

#[test]
fn a_stopped_query_gives_back_its_thread_within_a_second_and_its_memory() {
    let Some(cell) = Cell::with(&[]) else { return };
    let statement = |number: u32| {
        let other = number * 7 % 60_000;
        format!("<urn:s{number}> <urn:p{}> <urn:s{other}> .\n", number % 50)
    };
    let many: String = (0..60_000).map(statement).collect();
    let _many = cell.file("many.ttl", &many);
    let text = "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\n\
                endpoint: opc.tcp://127.0.0.1:0\nsecurity: [None]\nknowledge: [many.ttl]\n";
    let path = cell.file("mes.yaml", text);
    let mes = StartedChild::new("mes", &program("ua-mes"))
        .args([path.to_str().unwrap(), "--interface", "lo", "--lds", "none"])
        .start();
    let asked = |query: &str| post("/sparql", "application/sparql-query", query);
    eventually("the statements are known", SOON, || get("/status"));
    let before = resident(mes.id());
    for query in [
        "SELECT (COUNT(*) AS ?n) {?a ?b ?c . ?d ?e ?f . ?g ?h ?i}",
        "SELECT (COUNT(*) AS ?n) {?a (!<a:b>)* ?b . ?b (!<a:c>)* ?c . ?d (!<a:b>)* ?e}",
        "SELECT * {?a ?b ?c . ?d ?e ?f} ORDER BY ?f ?c",
    ] {
        // The limit of time or of memory.
        let status = asked(query);
        assert!(matches!(status, Some(503 | 507)), "{query}: {status:?}");
        eventually("its thread ends", Duration::from_secs(1), || {
            (queries_of(mes.id()) == 0).then_some(())
        });
        assert_eq!(asked("ASK {<urn:s1> ?p <urn:s7>}"), Some(200), "{query}");
    }
    let (most, after) = (peak(mes.id()), resident(mes.id()));
    assert!(
        most > 2 * before,
        "the queries took no memory: {most} bytes"
    );
    assert!(
        after <= before / 2 * 3,
        "{} MiB before the queries, {} MiB after them",
        before >> 20,
        after >> 20
    );
}

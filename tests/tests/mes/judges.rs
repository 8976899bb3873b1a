//! Programs of others judge the MES: pySHACL its report of shapes, SPARQLWrapper its endpoint,
//! SpiffWorkflow the order of the steps of a BPMN file, and xmlschema the recipe of the examples.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, StartedChild, eventually, program};
use test_data::{foreign, own};

use super::{AT, EXAMPLES, SOON, get, list};

const SHAPES: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../plant/knowledge/tests/shapes"
);

/// Starts a MES with a list of files in a key of its YAML, and waits until it answers.
fn mes_with(cell: &Cell, key: &str, files: &[&Path]) -> Child {
    let names: Vec<_> = files
        .iter()
        .map(|file| {
            let name = file.file_name().unwrap().to_str().unwrap();
            fs::copy(file, cell.folder().join(name)).unwrap();
            name
        })
        .collect();
    let text = format!(
        "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\nsecurity: [None]\n\
         endpoint: opc.tcp://127.0.0.1:48401\nsparql: {AT}\n{key}: [{}]\n",
        names.join(", ")
    );
    let path = cell.file("mes.yaml", &text);
    let mes = StartedChild::new("mes", &program("ua-mes"))
        .args([path.to_str().unwrap(), "--interface", "lo", "--lds", "none"])
        .start();
    eventually("the MES answers", SOON, || get("/status"));
    mes
}

/// Returns the reports of ua-mes and of pySHACL for data.
fn reports(data: &Path) -> [Value; 2] {
    let Some(cell) = Cell::with(&[Peer::PythonJudges]) else {
        return [Value::Null, Value::Null];
    };
    let shapes = Path::new(SHAPES).join("shapes.ttl");
    let _mes = mes_with(&cell, "knowledge", &[data, &shapes]);
    let url = format!("http://{AT}/report");
    let files = [data, &shapes].map(|file| file.to_str().unwrap());
    let said = cell.asyncua_once("shacl_judge.py", &[files[0], files[1], &url]);
    ["ours", "theirs"].map(|of| said[0][of].clone())
}

#[test]
fn pyshacl_reports_the_same_results_for_good_and_for_bad_data() {
    let [ours, theirs] = reports(&Path::new(SHAPES).join("data.ttl"));
    if ours.is_null() {
        return;
    }
    assert_eq!(ours, theirs);
    assert_eq!(ours["conforms"], false);
    assert_eq!(list(&ours, "results").len(), 23);
    let warning = json!("<http://www.w3.org/ns/shacl#Warning>");
    let mut results = list(&ours, "results").iter();
    assert!(results.any(|result| result[3] == warning), "{ours}");
    let [ours, theirs] = reports(&own("shacl/good.ttl"));
    assert_eq!(ours, theirs);
    assert_eq!(ours, json!({"conforms": true, "results": []}));
}

#[test]
fn sparqlwrapper_queries_and_changes_the_knowledge_and_gets_the_codes_of_errors() {
    let Some(cell) = Cell::with(&[Peer::PythonJudges]) else {
        return;
    };
    let _mes = mes_with(&cell, "knowledge", &[]);
    let said = cell.asyncua_once("sparql_client.py", &[&format!("http://{AT}")]);
    let of = |request: &str, key: &str| -> Vec<Value> {
        let lines = said.iter().filter(|line| line["request"] == request);
        lines.map(|line| line[key].clone()).collect()
    };
    assert_eq!(of("insert", "status"), [200]);
    let row = |property: &str, value: Value| json!({"p": ["uri", format!("urn:w:{property}")], "o": value});
    let rows = json!([
        row("p", json!(["literal", "1"])),
        row("p", json!(["literal", "2.5"])),
        row("p", json!(["literal", "zwölf"])),
        row("q", json!(["bnode", ""])),
    ]);
    assert_eq!(of("select", "rows"), [rows.clone(), rows]);
    assert_eq!(of("select as XML", "rows"), [4]);
    assert_eq!(of("ask", "told"), [true, false]);
    assert_eq!(of("construct", "objects"), [json!(["urn:w:a"])]);
    // An update and a query that are cut; the graph of derived statements is read-only.
    assert_eq!(of("cut", "status"), [400, 400]);
    assert_eq!(of("protected", "status"), [403]);
    assert_eq!(of("rows after faults", "rows"), [4]);
    assert_eq!(of("rows after delete", "rows"), [0]);
}

/// Returns the rounds of tasks by ua-mes and by SpiffWorkflow, for each case.
fn rounds(cell: &Cell, file: &Path, process: &str, cases: &Value) -> Vec<[Value; 2]> {
    let _mes = mes_with(cell, "recipes", &[file]);
    let cases = cell.file("cases.json", &cases.to_string());
    let url = format!("http://{AT}");
    let arguments = [
        file.to_str().unwrap(),
        &url,
        process,
        cases.to_str().unwrap(),
    ];
    let said = cell.asyncua_once("bpmn_judge.py", &arguments);
    let both = said
        .iter()
        .map(|line| ["ours", "theirs"].map(|of| line[of].clone()));
    both.collect()
}

#[test]
fn spiffworkflow_runs_the_tasks_of_bpmn_files_in_the_order_of_our_plan() {
    let Some(cell) = Cell::with(&[Peer::PythonJudges]) else {
        return;
    };
    let both = ["dose", "heat the reactor"];
    let cases = json!([
        {},
        {"failed": ["dose"]},
        {"timed out": ["stir"]},
        {"failed": ["dose"], "timed out": ["stir"]},
    ]);
    let expected = [
        json!([both, ["stir"]]),
        json!([both, ["rinse"], ["stir"]]),
        json!([both, ["stir"], ["empty the mixer"]]),
        json!([both, ["rinse"], ["stir"], ["empty the mixer"]]),
    ];
    let batch = Path::new(EXAMPLES).join("batch.bpmn");
    let found = rounds(&cell, &batch, "urn:ua-bridge:bpmn:StirOrRinse", &cases);
    assert_eq!(found, expected.map(|tasks| [tasks.clone(), tasks]));

    let cases = [0.2, 0.5].map(|level| json!({"values": {"weigh": {"Level": level}}}));
    let expected = ["fill", "empty"].map(|task| json!([["weigh"], [task], ["stir"]]));
    let weighed = own("bpmn/weighed.bpmn");
    let found = rounds(&cell, &weighed, "urn:ua-bridge:bpmn:Weighed", &json!(cases));
    assert_eq!(found, expected.map(|tasks| [tasks.clone(), tasks]));
}

#[test]
fn the_recipe_of_the_examples_is_valid_by_the_schemas_of_b2mml() {
    let Some(cell) = Cell::with(&[Peer::PythonJudges]) else {
        return;
    };
    let Some(schema) = foreign("b2mml/AllSchemas.xsd") else {
        return;
    };
    let recipe = Path::new(EXAMPLES).join("batch.xml");
    let text = fs::read_to_string(&recipe).unwrap();
    let wrong = cell.file("wrong.xml", &text.replace("ToIDValue>", "ToIDWrong>"));
    let files = [&schema, &recipe, &wrong].map(|file| file.to_str().unwrap());
    let said = cell.asyncua_once("recipe_judge.py", &files);
    assert_eq!(said[0]["faults"], json!([]));
    let faults = said[1]["faults"].to_string();
    assert!(faults.contains("ToIDWrong"), "{faults}");
}

//! The nodes of running servers in the knowledge, with the terms of their NodeSet.

use std::fs;
use std::net::TcpListener;

use nix::sys::signal::Signal;
use serde_json::Value;
use system_tests::{Cell, Child, Peer, StartedChild, eventually, http_get, program};

use super::{AT, SOON, get, list, rows, space, start};

const LEFT: &str = "opc.tcp://127.0.0.1:48411";
const RIGHT: &str = "opc.tcp://127.0.0.1:48412";
const SILENT: &str = "127.0.0.1:48413";
const BULK: &str = "opc.tcp://127.0.0.1:48414";

/// Starts a server with presses.
fn presses(cell: &Cell, endpoint: &str, uri: &str, more: &[&str]) -> Child {
    let args = [&[endpoint, uri][..], more].concat();
    let server = cell.asyncua_started("opcua_presses.py", &args);
    server.told().start().ready(SOON)
}

fn mes(cell: &Cell, servers: &str) -> Child {
    let text = format!(
        "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\n\
         endpoint: opc.tcp://127.0.0.1:0\nservers:\n{servers}"
    );
    let path = cell.file("mes.yaml", &text);
    StartedChild::new("mes", &program("ua-mes"))
        .args([path.to_str().unwrap(), "--interface", "lo", "--lds", "none"])
        .start()
}

/// Returns the status of a server when it is as wanted.
fn server(name: &str, what: &str, wanted: impl Fn(&Value) -> bool) -> Value {
    eventually(what, SOON, || {
        let status = get("/status")?;
        let mut servers = list(&status, "servers").iter();
        servers
            .find(|server| server["server"] == name && wanted(server))
            .cloned()
    })
}

fn current(name: &str) -> Value {
    server(name, "the nodes are in the graph", |server| {
        server["state"] == "current"
    })
}

/// Returns the rows of a SELECT query, each as the texts of its variables.
fn select(query: &str, variables: &[&str]) -> Vec<Vec<String>> {
    let escaped: String = query.bytes().map(|byte| format!("%{byte:02X}")).collect();
    let answer = http_get(AT, &format!("/sparql?query={escaped}")).unwrap();
    let answer: Value = serde_json::from_str(&answer).unwrap();
    let rows = list(&answer["results"], "bindings").iter().map(|row| {
        let text = |name: &&str| row[*name]["value"].as_str().unwrap_or_default().to_owned();
        variables.iter().map(text).collect()
    });
    let mut rows: Vec<Vec<String>> = rows.collect();
    rows.sort();
    rows
}

/// The presses of a graph, by the type above their type: name, force, and the symbol of its unit.
fn question(graph: &str) -> Vec<Vec<String>> {
    let query = format!(
        "PREFIX ua: <urn:ua-bridge:plant#> PREFIX rdfs: <http://www.w3.org/2000/01/rdf-schema#>
         SELECT ?name ?force ?unit ?steps {{ GRAPH <{graph}> {{
           ?press a ?type ; ua:browseName ?name .
           ?type rdfs:subClassOf <urn:example:presses#i=1000> .
           ?press <http://opcfoundation.org/UA/#i=47> ?variable , ?list , ?method .
           ?variable ua:browseName \"Force\" ; ua:value ?force ;
             ua:dataType <http://opcfoundation.org/UA/#i=11> ;
             <http://opcfoundation.org/UA/#i=46> ?units .
           ?units ua:browseName \"EngineeringUnits\" ; ua:valueJson ?unit .
           ?list ua:browseName \"Steps\" ; ua:valueJson ?steps .
           ?method ua:nodeClass \"Method\" ; ua:browseName \"Stop\" }} }}"
    );
    let mut rows = select(&query, &["name", "force", "unit", "steps"]);
    for row in &mut rows {
        let unit: Value = serde_json::from_str(&row[2]).unwrap();
        row[2] = format!("{} {}", unit["UnitId"], unit["DisplayName"]["Text"]);
    }
    rows
}

fn row(name: &str, force: &str) -> Vec<String> {
    let unit = "\"5129559\" \"N\"";
    [name, force, unit, "[1,2,3]"].map(str::to_owned).to_vec()
}

/// Returns the IRIs of all presses.
fn iris() -> Vec<Vec<String>> {
    let query = "SELECT DISTINCT ?press { ?press a <urn:example:presses#i=1001> ;
        <http://opcfoundation.org/UA/#i=47> ?part .
        FILTER NOT EXISTS { ?press a <http://www.w3.org/2002/07/owl#Class> } }";
    select(query, &["press"])
}

#[test]
fn a_running_server_answers_the_question_of_its_nodeset_and_its_loss_removes_its_nodes() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let nodeset = cell.folder().join("presses.xml");
    let export = ["--press", "one", "--export", nodeset.to_str().unwrap()];
    let mut left = presses(&cell, LEFT, "urn:example:left", &export);
    let right = presses(&cell, RIGHT, "urn:example:right", &["--press", "one"]);
    // A server that accepts connections and never answers.
    let silent = TcpListener::bind(SILENT).unwrap();
    let silent_url = format!("opc.tcp://{SILENT}");
    let servers = format!("  - {LEFT}\n  - {{server: {RIGHT}, depth: 8}}\n  - {silent_url}\n");
    let _mes = mes(&cell, &servers);

    let status = current(LEFT);
    assert_eq!(
        (&status["application_uri"], &status["complete"]),
        (&"urn:example:left".into(), &true.into())
    );
    let graph = status["graph"].as_str().unwrap().to_owned();
    assert_eq!(graph, "urn:ua-bridge:graph:server:urn%3Aexample%3Aleft");
    let live = question(&graph);
    assert_eq!(live, [row("one", "12.5")]);
    current(RIGHT);
    let maker = "urn%3Aexample%3Apresses";
    let of = |server: &str, id: u32| {
        vec![format!(
            "urn:ua-bridge:server:urn%3Aexample%3A{server}#{maker};i={id}"
        )]
    };
    assert_eq!(
        iris(),
        [of("left", 5000), of("right", 5000)],
        "each its own"
    );
    let found = eventually("the silent server is a finding", 2 * SOON, || {
        let status = get("/status")?;
        let mut findings = list(&status, "findings").iter();
        findings
            .find(|found| found["source"] == silent_url.as_str())
            .cloned()
    });
    let what = found["what"].as_str().unwrap();
    assert!(what.starts_with("it is not connected: "), "{what}");
    drop(silent);

    // The same question for the NodeSet that the server exported.
    let (written, turtle) = space(&["owl", nodeset.to_str().unwrap()]);
    assert!(written, "{turtle}");
    let file = cell.file("presses.ttl", &turtle);
    let (added, told) = space(&["source", "add", file.to_str().unwrap()]);
    assert!(added, "{told}");
    assert_eq!(question("urn:ua-bridge:graph:file:presses.ttl"), live);

    // The server reports a change of its model.
    left.tell("another press");
    eventually("the new press is in the graph", SOON, || {
        (question(&graph) == [row("late", "21.5"), row("one", "12.5")]).then_some(())
    });

    right.signal(Signal::SIGKILL);
    drop(right);
    let lost = server(RIGHT, "the server is lost", |server| {
        server["state"] == "not_connected"
    });
    assert_eq!(lost["nodes"], 0, "{lost}");
    let own = [of("left", 5000), of("left", 5090)];
    let of_nodeset = vec!["urn:example:presses#i=5000".to_owned()];
    let rest = || [std::slice::from_ref(&of_nodeset), &own[..]].concat();
    eventually("its nodes are removed", SOON, || {
        (iris() == rest()).then_some(())
    });
    let both = ["--press", "one", "--press", "two"];
    let _right = presses(&cell, RIGHT, "urn:example:right", &both);
    let mut all = [rest(), vec![of("right", 5000), of("right", 5010)]].concat();
    all.sort();
    eventually(
        "the nodes of the restarted server are in the graph",
        SOON,
        || (iris() == all).then_some(()),
    );
}

#[test]
fn servers_of_the_yaml_are_read_again_by_sighup_and_removed_with_their_entries() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _bulk = presses(
        &cell,
        BULK,
        "urn:example:bulk",
        &["--press", "one", "--variables", "3000"],
    );
    let mes = mes(&cell, &format!("  - {{server: {BULK}, nodes: 15000}}\n"));
    let first = current(BULK);
    let nodes = first["nodes"].as_u64().unwrap();
    assert!(nodes > 3_030, "{first}");
    mes.signal(Signal::SIGHUP);
    server(BULK, "the nodes are read again", |server| {
        server["state"] == "current" && server["reads"] == 2 && server["reason"] == "command"
    });
    let path = cell.folder().join("mes.yaml");
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replace("nodes: 15000", "nodes: 100")).unwrap();
    mes.signal(Signal::SIGHUP);
    server(BULK, "the nodes are limited", |server| {
        server["state"] == "current" && server["complete"] == false && server["nodes"] == 100
    });
    let status = get("/status").unwrap();
    let found: Vec<&Value> = list(&status, "findings").iter().collect();
    let what = found[0]["what"].as_str().unwrap_or_default();
    assert!(what.contains("more than 100 nodes"), "{found:?}");
    fs::write(
        &path,
        text.replace("servers:", "# servers:")
            .replace("  - {", "# - {"),
    )
    .unwrap();
    mes.signal(Signal::SIGHUP);
    eventually("the graph is removed", SOON, || {
        let status = get("/status")?;
        let is_gone = list(&status, "servers").is_empty() && list(&status, "findings").is_empty();
        let graphs = list(&status, "graphs").iter();
        let is_kept = graphs.filter(|graph| graph["kind"] == "server").count();
        (is_gone && is_kept == 0).then_some(())
    });
}

#[test]
fn the_nodes_of_a_discovered_component_leave_its_rows_in_named_questions_alone() {
    let Some(cell) = Cell::with(&[]) else { return };
    let _gripper = start(&cell, "ua-component", "parallel-gripper.yaml", &[], &[]);
    let _mes = mes(&cell, "  - discovered\n");
    eventually("the nodes of the gripper are in the graph", SOON, || {
        let status = get("/status")?;
        let mut servers = list(&status, "servers").iter();
        let is_read = |server: &&Value| {
            server["application_uri"] == "urn:example:gripper" && server["state"] == "current"
        };
        servers.find(is_read).cloned()
    });
    let of = |question: &str, column: &str| {
        let rows = rows(question);
        let own = rows.iter().filter(|row| row[column] == "parallel-gripper");
        own.count()
    };
    eventually("the gripper is a component", SOON, || {
        (of("components", "name") > 0).then_some(())
    });
    assert_eq!(of("components", "name"), 1);
    assert_eq!(
        of("what-can-run", "component"),
        2,
        "{:?}",
        rows("what-can-run")
    );
    let skills = "PREFIX ua: <urn:ua-bridge:plant#>
        SELECT ?name { ?skill a <http://www.w3id.org/hsu-aut/css#Skill> ; ua:nodeId ?id .
          GRAPH ?graph { ?server a ua:Server ; ua:applicationUri \"urn:example:gripper\" .
            ?node ua:nodeId ?id ; ua:browseName ?name } }";
    let names = select(skills, &["name"]);
    assert_eq!(names.len(), 2, "{names:?}");
}

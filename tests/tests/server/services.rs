//! The responses to requests of asyncua that a server has to refuse, one row of a table after the
//! other. `docs/conformance.md` shows the table.

use super::*;

const VARIABLES: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 2
variables:
  - {node: ns=2;i=10, name: temperature, type: Double, origin: 2}
  - {node: ns=2;i=30, name: number, type: Double, origin: 0}
  - {node: ns=2;i=31, name: list, type: 'Int32[]', origin: 0}
  - {node: ns=2;i=32, name: text, type: String, origin: 0}
  - {node: ns=2;i=33, name: ranged, type: Double, origin: 0, range: [0, 10]}
server:
  security: [None]
";

#[test]
fn services_respond_as_the_page_of_conformance_says() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = serving(&cell, VARIABLES);
    let rows = cell.asyncua_once("opcua_services.py", &[SERVER_ENDPOINT]);
    let text = |row: &Value, key: &str| row[key].as_str().unwrap_or_default().to_owned();
    let differing: Vec<&Value> = rows
        .iter()
        .filter(|row| row["got"] != row["expected"])
        .collect();
    assert!(differing.is_empty(), "{differing:#?}");
    let line = |row: &Value| {
        let [service, clause, case, expected] =
            ["service", "clause", "case", "expected"].map(|key| text(row, key));
        format!("| {service} | {clause} | {case} | `{expected}` |\n")
    };
    let table: String = rows.iter().map(line).collect();
    let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/conformance.md");
    let page = fs::read_to_string(page).unwrap();
    assert!(page.contains(&table), "{page} has to contain\n{table}");
}

#[test]
fn a_durable_subscription_outlives_its_client_and_their_number_is_bounded() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _server = serving(&cell, VARIABLES);
    let lines = cell.asyncua_once("opcua_durable.py", &[SERVER_ENDPOINT]);
    // Anonymous users without security continue no subscription of another session (5.14.7.2).
    let statuses = json!({"plain": "BadSubscriptionIdInvalid", "durable": "BadUserAccessDenied"});
    // The server has 100 durable subscriptions, including the subscription that was left behind.
    let bound = json!({"made": 99, "refused": "BadTooManySubscriptions", "rejected": 1});
    assert_eq!(lines, [statuses, bound]);
}

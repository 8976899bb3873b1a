//! The folders of variables, also after a restart and a reload.

use super::*;

fn mapping(more: &str) -> String {
    format!(
        "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 2
server:
  security: [None]
variables:
  - {{node: ns=2;i=12, name: Line.Oven.Heat, type: Double, origin: 2}}
  - {{node: ns=2;i=10, name: temperature, type: Double, origin: 2}}
{more}"
    )
}

const CONVEYOR: &str = "  - {node: ns=2;i=11, name: Line.Conveyor.Speed, type: Double, origin: 2}
  - {node: ns=2;s=On, alias: 31, name: Line.On, type: Boolean, origin: 2}
";

/// Returns the nodes and names below the folder of the space, and in its subfolders.
fn stand(cell: &Cell) -> Vec<Value> {
    let folders = ["", "/Line", "/Line/Oven", "/Line/Conveyor"];
    let folders = folders.map(|path| format!("ns=1;s=UaSpace.2{path}"));
    let folders = folders.iter().map(String::as_str);
    let arguments: Vec<&str> = [SERVER_ENDPOINT, "--children"]
        .into_iter()
        .chain(folders)
        .collect();
    let told = cell.asyncua_once("opcua_read.py", &arguments);
    told.iter()
        .map(|line| json!([line["children"], line["names"]]))
        .collect()
}

#[test]
fn dots_of_names_are_folders_and_all_stands_where_it_did_after_restarts_and_reloads() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let server = serving(&cell, &mapping(CONVEYOR));
    let first = stand(&cell);
    assert_eq!(
        first,
        [
            json!([
                ["ns=1;s=UaSpace.2/Line", "ns=2;i=10"],
                ["Line", "temperature"]
            ]),
            json!([
                [
                    "ns=1;s=UaSpace.2/Line/Oven",
                    "ns=1;s=UaSpace.2/Line/Conveyor",
                    "ns=2;s=On"
                ],
                ["Oven", "Conveyor", "On"]
            ]),
            json!([["ns=2;i=12"], ["Heat"]]),
            json!([["ns=2;i=11"], ["Speed"]]),
        ]
    );
    drop(server);
    let mut server = serving(&cell, &mapping(CONVEYOR));
    assert_eq!(stand(&cell), first);

    drop(cell.file("server.yaml", &mapping("")));
    server.wait_for_line("removed=2", SOON);
    eventually("an empty folder goes", SOON, || {
        let now = stand(&cell);
        (now[1] == json!([["ns=1;s=UaSpace.2/Line/Oven"], ["Oven"]]) && now[3] == json!([[], []]))
            .then_some(())
    });
    drop(cell.file("server.yaml", &mapping(CONVEYOR)));
    server.wait_for_line("added=2", SOON);
    eventually("all stands where it did", SOON, || {
        (stand(&cell) == first).then_some(())
    });
}

//! Pictures of a module, compared with those that lxml finds in its manifest.

use std::collections::BTreeMap;

use mtp::{Module, ModulePicture};
use serde_json::{Value, json};
use system_tests::Cell;

use super::{sorted, space, stdout};

/// Compares the pictures of a module with those of the judge.
pub(super) fn are_as_judged(module: &Module, judged: &Value) {
    let found: Vec<Value> = module
        .pictures
        .iter()
        .map(|picture| shown(module, picture))
        .collect();
    let mut judged = judged["pictures"].as_array().unwrap().clone();
    for picture in &mut judged {
        let links = picture["links"].as_array().unwrap();
        picture["links"] = json!(sorted(links.clone()));
    }
    assert_eq!(found, judged, "{}", module.name);
}

fn shown(module: &Module, picture: &ModulePicture) -> Value {
    let assembly = |id: &str| {
        let mut all = module.assemblies.iter();
        all.find(|one| one.id == id).map(|one| &one.name)
    };
    let objects = picture.objects.iter().map(|one| {
        json!([
            one.name,
            one.class,
            one.position,
            one.size,
            one.rotation,
            one.eclass,
            one.assembly.as_deref().and_then(assembly)
        ])
    });
    let connections = picture.connections.iter();
    let connections = connections.map(|one| json!([one.name, one.class, one.path]));
    let owners: BTreeMap<&str, &str> = owners(picture).collect();
    let links = picture.links.iter().map(|ports| {
        let mut names = ports.each_ref().map(|port| owners[&**port]);
        names.sort_unstable();
        json!(names)
    });
    let groups = picture.objects.iter().map(|one| &one.group);
    let groups = groups.chain(picture.connections.iter().map(|one| &one.group));
    let mut groups: Vec<&String> = groups.filter(|group| !group.is_empty()).collect();
    groups.dedup();
    json!({
        "name": picture.name,
        "size": picture.size,
        "objects": objects.collect::<Vec<_>>(),
        "connections": connections.collect::<Vec<_>>(),
        "ports": owners.len(),
        "links": sorted(links.collect()),
        "groups": groups.len(),
    })
}

/// Returns the IDs of ports with the names of their objects and connections.
fn owners(picture: &ModulePicture) -> impl Iterator<Item = (&str, &str)> {
    let objects = picture.objects.iter().map(|one| (&one.name, &one.ports));
    let connections = picture.connections.iter();
    let connections = connections.map(|one| (&one.name, &one.ports));
    let all = objects.chain(connections);
    all.flat_map(|(name, ports)| ports.iter().map(move |port| (&*port.id, &**name)))
}

/// Checks the counts of the picture of column.aml, its list and its drawing.
pub(super) fn are_listed_and_drawn(column: &str, checked: &Value) {
    let counts = ["pictures", "picture_objects", "picture_connections"];
    let counts = counts.map(|name| checked[name].as_u64().unwrap());
    assert_eq!(counts, [1, 4, 3], "{checked}");
    let pictures = space(&["mtp", "picture", column, "Overview", "--json"]);
    let pictures: Value = serde_json::from_str(&stdout(&pictures)).unwrap();
    let heater = &pictures[0]["objects"][0];
    assert_eq!(heater["shows"], "Heater", "{pictures}");
    assert_eq!(heater["joins"], json!(["Pipe", "Signal"]), "{pictures}");
    let table = stdout(&space(&["mtp", "picture", column]));
    assert!(table.contains("MeasurementLine"), "{table}");
    let other = space(&["mtp", "picture", column, "Detail"]);
    assert_eq!(other.status.code(), Some(64), "{other:?}");
}

/// Checks the note about an element of column.aml without a place in the model, and the drawing of
/// its picture.
pub(super) fn are_noted_if_left_out(cell: &Cell, column: &str) {
    let border = column.replace(
        "MTPHMISUCLib/Connection/FunctionLine",
        "MTPHMISUCLib/Border",
    );
    let border = cell.file("border.aml", &border).display().to_string();
    let checked = space(&["mtp", "check", "--json", &border]);
    assert!(checked.status.success(), "{checked:?}");
    let checked: Value = serde_json::from_str(&stdout(&checked)).unwrap();
    assert_eq!(checked["findings"][0]["severity"], "note");
    assert_eq!(checked["findings"][0]["element"], "MTPHMISUCLib/Border");
    let drawing = cell.folder().join("overview.svg");
    let path = drawing.display().to_string();
    let draw = ["mtp", "picture", &border, "--svg", &path];
    let drawn = space(&draw);
    assert!(drawn.status.success(), "{drawn:?}");
    let svg = std::fs::read_to_string(drawing).unwrap();
    assert_eq!(svg.matches("<polyline").count(), 2, "{svg}");
    let again = space(&draw);
    assert_eq!(again.status.code(), Some(74), "a file is not replaced");
}

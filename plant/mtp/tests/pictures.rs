//! Pictures of manifests: objects, connections, links, statements, drawings and findings.
#![expect(clippy::unwrap_used, clippy::panic, reason = "a test may")]

mod common;

use std::collections::BTreeMap;

use common::of_class;
use mtp::vocabulary as v;
use mtp::{Module, ModulePicture, Object, PictureObject};
use test_data::{read_foreign, read_own};

/// Numbers as counted by another XML library: pictures, objects, connections, ports, links, objects
/// with a data assembly.
const ALL: [(&str, [usize; 6]); 8] = [
    (
        "cps-edp-mixing-1.1.2/Manifest.aml",
        [1, 28, 34, 124, 61, 24],
    ),
    ("huber-v14.1/Manifest.aml", [1, 6, 4, 16, 8, 3]),
    (
        "mtppy-recipe/example_recipe_manifest.aml",
        [0, 0, 0, 0, 0, 0],
    ),
    ("p2o-bucket/Manifest.aml", [1, 4, 0, 0, 0, 1]),
    ("p2o-dosing-1.0.3/Manifest.aml", [1, 17, 14, 58, 29, 13]),
    ("pimad-core/PiMAd-core.0-0-1.aml", [0, 0, 0, 0, 0, 0]),
    (
        "recipol-hc30-siemens/2026-05-18-HC30_Stirring_V8.aml",
        [5, 8, 8, 0, 0, 2],
    ),
    (
        "zvei-stirred-reactor-v1/Manifest.aml",
        [1, 10, 13, 26, 0, 8],
    ),
];

fn column() -> Module {
    Module::read(&read_own("mtp/column.aml")).unwrap()
}

fn overview(module: &Module) -> &ModulePicture {
    let [picture] = &*module.pictures else {
        panic!("{:?}", module.pictures);
    };
    picture
}

fn object<'p>(picture: &'p ModulePicture, name: &str) -> &'p PictureObject {
    let mut objects = picture.objects.iter();
    objects.find(|one| one.name == name).unwrap()
}

#[test]
fn every_picture_of_eight_manifests_is_read() {
    for (file, wanted) in ALL {
        let Some(text) = read_foreign(&format!("mtp/{file}")) else {
            return;
        };
        let module = Module::read(&text).unwrap();
        let pictures = &module.pictures;
        let objects = || pictures.iter().flat_map(|one| &one.objects);
        let connections = || pictures.iter().flat_map(|one| &one.connections);
        let of_objects = objects().map(|one| one.ports.len()).sum::<usize>();
        let of_connections = connections().map(|one| one.ports.len()).sum::<usize>();
        let found = [
            pictures.len(),
            objects().count(),
            connections().count(),
            of_objects + of_connections,
            pictures.iter().map(|one| one.links.len()).sum(),
            objects().filter(|one| one.assembly.is_some()).count(),
        ];
        assert_eq!(found, wanted, "{file}");
        let left_out: Vec<_> = module
            .findings
            .iter()
            .filter(|one| one.about.contains("HMI") || one.about.contains("InternalLink"))
            .collect();
        assert_eq!(left_out, Vec::<&mtp::MtpFinding>::new(), "{file}");
        for one in objects() {
            assert!(one.position.is_some(), "{file}: {one:?}");
            assert_eq!(one.size.is_some(), one.class == "VisualObject", "{file}");
        }
        for one in connections() {
            assert!(one.path.len() > 1, "{file}: {one:?}");
        }
        let all = module.triples("urn:m", &BTreeMap::new());
        assert_eq!(of_class(&all, v::PICTURE), wanted[0], "{file}");
        assert_eq!(of_class(&all, v::PICTURE_OBJECT), wanted[1], "{file}");
        assert_eq!(of_class(&all, v::PICTURE_CONNECTION), wanted[2], "{file}");
        let shown = all.iter().filter(|one| one.predicate == v::SHOWS_ELEMENT);
        assert_eq!(shown.count(), wanted[5], "{file}");
    }
}

#[test]
fn a_picture_has_its_objects_connections_and_links() {
    let module = column();
    let picture = overview(&module);
    assert_eq!(
        (&*picture.name, &*picture.level, picture.size),
        ("Overview", "0", Some([320.0, 240.0]))
    );
    let names: Vec<(&str, &str)> = picture
        .objects
        .iter()
        .map(|one| (&*one.name, &*one.class))
        .collect();
    assert_eq!(
        names,
        [
            ("Heater", "VisualObject"),
            ("Level", "VisualObject"),
            ("Feed", "Source"),
            ("Waste", "Sink")
        ]
    );
    let heater = object(picture, "Heater");
    assert_eq!(
        (heater.position, heater.size, heater.rotation, heater.layer),
        (Some([100.0, 80.0]), Some([60.0, 90.0]), 90.0, 2.0)
    );
    assert_eq!(
        (&*heater.eclass, &*heater.eclass_version),
        ("27200204", "10.1")
    );
    assert_eq!(heater.assembly.as_deref(), Some("d-Heater"));
    assert_eq!(object(picture, "Level").group, "Heating");
    let [pipe, signal, interlock] = &*picture.connections else {
        panic!("{:?}", picture.connections);
    };
    assert!(pipe.is_directed && !signal.is_directed);
    assert_eq!(pipe.path, [[32.0, 125.0], [100.0, 125.0]]);
    assert_eq!(signal.path.len(), 3);
    assert_eq!(
        (&*interlock.class, interlock.ports.len()),
        ("FunctionLine", 0)
    );
    // Links by the ID of an interface, and by the ID of a port with and without braces.
    let neighbours = picture.neighbours();
    let of = |id: &str| -> Vec<&str> {
        let found = neighbours.get(id).into_iter().flatten();
        found.map(|(_, name)| *name).collect()
    };
    assert_eq!(of("pic-5"), ["Heater", "Feed"]);
    assert_eq!(of("pic-6"), ["Heater", "Level"]);
    assert_eq!(of("pic-1"), ["Pipe", "Signal"]);
    assert_eq!(of("pic-7"), Vec::<&str>::new());
}

#[test]
fn pictures_are_statements() {
    let all = column().triples("urn:m", &BTreeMap::new());
    let about = |subject: &str, predicate: &str| -> Vec<Object> {
        let of = all
            .iter()
            .filter(|one| one.subject == subject && one.predicate == predicate);
        of.map(|one| one.object.clone()).collect()
    };
    let iri = |end: &str| Object::Iri(format!("urn:m/{end}"));
    assert_eq!(about("urn:m", v::HAS_PICTURE), [iri("picture/pic")]);
    assert_eq!(about("urn:m/picture/pic", v::HAS_PICTURE_PART).len(), 7);
    let heater = "urn:m/picture/pic/object/pic-1";
    assert_eq!(about(heater, v::LEFT), [Object::Number(100.0)]);
    assert_eq!(about(heater, v::SHOWS_ELEMENT), [iri("element/d-Heater")]);
    assert_eq!(
        about(heater, v::IS_JOINED_WITH),
        [
            iri("picture/pic/connection/pic-5"),
            iri("picture/pic/connection/pic-6")
        ]
    );
}

#[test]
fn a_drawing_has_a_box_for_each_device_and_a_line_for_each_connection() {
    let mut module = column();
    module.pictures[0].objects[0].name = "R&I <1>\u{7}".to_owned();
    let svg = overview(&module).svg(&module.assemblies);
    assert!(svg.contains("viewBox=\"0 0 320 240\""), "{svg}");
    assert!(svg.contains(">R&amp;I &lt;1&gt;</text>"), "{svg}");
    assert!(svg.contains("<title>Heater (PIDCtrl)</title>"), "{svg}");
    // The size is that of the rotated symbol.
    let box_of_heater = "<rect x=\"100\" y=\"80\" width=\"60\" height=\"90\" rx=\"4\"/>";
    assert!(svg.contains(box_of_heater), "{svg}");
    assert_eq!(svg.matches("<polyline").count(), 3, "{svg}");
    assert_eq!(svg.matches("marker-end").count(), 1, "{svg}");
    assert_eq!(svg.matches("<circle").count(), 2, "{svg}");
    assert!(svg.contains("points=\"160,125 190,125 220,120\""), "{svg}");
}

#[test]
fn a_device_without_a_size_is_drawn_as_its_name() {
    let mut module = column();
    module.pictures[0].objects[0].size = None;
    let svg = overview(&module).svg(&module.assemblies);
    let heater = "<g class=\"plain\"><title>Heater (PIDCtrl)</title>\
                  <text x=\"100\" y=\"80\">Heater</text></g>";
    assert!(svg.contains(heater), "{svg}");
    assert_eq!(svg.matches("<circle").count(), 2, "{svg}");
}

#[test]
fn parts_of_a_higher_layer_are_drawn_later() {
    let module = column();
    let svg = overview(&module).svg(&module.assemblies);
    let at = |text: &str| svg.find(text).unwrap_or_else(|| panic!("{text}: {svg}"));
    // The heater and the pipe are the first in the file.
    assert!(at(">Level</text>") < at(">Waste</text>"), "{svg}");
    assert!(at(">Waste</text>") < at(">Heater</text>"), "{svg}");
    assert!(at(">Interlock (") < at(">Pipe ("), "{svg}");
}

#[test]
fn a_drawing_without_a_size_is_as_large_as_its_parts() {
    let mut module = column();
    let view_box = |module: &Module| -> String {
        let svg = overview(module).svg(&module.assemblies);
        let (_, rest) = svg.split_once("viewBox=\"").unwrap();
        rest.split('"').next().unwrap().to_owned()
    };
    for size in [None, Some([0.0, 240.0])] {
        module.pictures[0].size = size;
        // The right side of the level, the lowest corner, and the margin.
        assert_eq!(view_box(&module), "0 0 320 220");
    }
    module.pictures[0].connections[0].path.push([400.0, 300.0]);
    assert_eq!(view_box(&module), "0 0 420 320");
}

/// Returns a manifest with a text replaced.
fn replaced(from: &str, to: &str) -> Module {
    let text = read_own("mtp/column.aml");
    assert!(text.contains(from), "{from}");
    Module::read(&text.replacen(from, to, 1)).unwrap()
}

/// Returns the findings without their lines.
fn findings(module: &Module) -> Vec<String> {
    let all = module.findings.iter();
    all.map(|one| format!("{}: {}", one.about, one.what))
        .collect()
}

/// Returns a picture with a size and contents.
fn picture(id: &str, contents: &str) -> String {
    format!(
        "<InternalElement Name=\"{id}\" ID=\"{id}\" RefBaseSystemUnitPath=\"MTPHMISUCLib/Picture\">\
         <Attribute Name=\"Width\"><Value>10</Value></Attribute>\
         <Attribute Name=\"Height\"><Value>10</Value></Attribute>{contents}</InternalElement>"
    )
}

#[test]
fn a_library_has_no_pictures() {
    let library = format!(
        "<SystemUnitClassLib Name=\"Own\">{}</SystemUnitClassLib></CAEXFile>",
        picture("template", "")
    );
    let module = replaced("</CAEXFile>", &library);
    assert_eq!(overview(&module).id, "pic");
    assert_eq!(findings(&module), Vec::<String>::new());
}

#[test]
fn a_picture_within_a_picture_is_read_once_and_is_not_left_out() {
    let gone = "<InternalLink RefPartnerSideA=\"gone\" RefPartnerSideB=\"gone-too\"/>";
    let inner = picture("inner", gone);
    let found = "inner: gone - gone-too: a side of the InternalLink names no port of a picture";
    let waste = "<InternalElement Name=\"Waste\"";
    let border = format!(
        "<InternalElement Name=\"B\" ID=\"b\" RefBaseSystemUnitPath=\"MTPHMISUCLib/Border\">{inner}\
         </InternalElement>{waste}"
    );
    let of_border = "MTPHMISUCLib/Border: not read (1 in the file)";
    // Below a port, an object, an element of an unknown class, and the picture.
    let connector = "<ExternalInterface Name=\"Connector\" ID=\"pic-1-in-c\"";
    let port = "<InternalElement Name=\"In\" ID=\"pic-1-in\"";
    for (from, to, wanted) in [
        (connector, format!("{inner}{connector}"), vec![found]),
        (port, format!("{inner}{port}"), vec![found]),
        (waste, border, vec![found, of_border]),
        (waste, format!("{inner}{waste}"), vec![found]),
    ] {
        let module = replaced(from, &to);
        assert_eq!(findings(&module), wanted, "{to}");
        let names: Vec<&str> = module.pictures.iter().map(|one| &*one.name).collect();
        assert_eq!(names, ["Overview", "inner"], "{to}");
        assert_eq!(module.pictures[0].links.len(), 4, "{to}");
    }
}

#[test]
fn links_do_not_join_parts_without_an_id_or_of_different_pictures() {
    let joined = |module: &Module, id: &str| -> Vec<String> {
        let neighbours = module.pictures[0].neighbours();
        let found = neighbours.get(id).into_iter().flatten();
        found.map(|(_, name)| (*name).to_owned()).collect()
    };
    let heater = "Name=\"Heater\" ID=\"pic-1\" RefBaseSystemUnitPath=\"MTPHMISUCLib";
    let module = replaced(heater, &heater.replace(" ID=\"pic-1\"", ""));
    assert_eq!(
        findings(&module),
        ["Overview/Heater: the object has no ID, so no link joins it"]
    );
    assert_eq!(joined(&module, "pic-5"), ["Feed"]);
    assert_eq!(joined(&module, ""), Vec::<String>::new());

    let pipe = "Name=\"Pipe\" ID=\"pic-5\"";
    let module = replaced(pipe, "Name=\"Pipe\"");
    assert_eq!(
        findings(&module),
        ["Overview/Pipe: the connection has no ID, so no link joins it"]
    );
    assert_eq!(joined(&module, "pic-1"), ["Signal"]);

    let module = replaced(" ID=\"pic-3-out\"", "");
    let wanted = [
        "Overview/Feed/Out: the port has no ID, so nothing links it",
        "Overview: pic-3-out-c - pic-5-1-c: a side of the InternalLink names no port of a picture",
    ];
    assert_eq!(findings(&module), wanted);

    let sink = "<InternalElement Name=\"End\" ID=\"end\" \
                RefBaseSystemUnitPath=\"MTPHMISUCLib/TopologyObject/Termination/Sink\">\
                <Attribute Name=\"X\"><Value>1</Value></Attribute>\
                <Attribute Name=\"Y\"><Value>1</Value></Attribute><InternalElement Name=\"In\" \
                ID=\"end-in\" RefBaseSystemUnitPath=\"MTPHMISUCLib/PortObject/Nozzle\"/>\
                </InternalElement>";
    for [from, to] in [
        ["end-in", "pic-1-in-c"],
        ["pic-1-in-c", "end-in"],
        ["pic-3-out-c", "pic-5-1-c"],
    ] {
        let link = format!("<InternalLink RefPartnerSideA=\"{from}\" RefPartnerSideB=\"{to}\"/>");
        let other = picture("other", &format!("{link}{sink}"));
        let module = replaced("</CAEXFile>", &format!("{other}</CAEXFile>"));
        let about = format!("other: {from} - {to}");
        let wanted = format!("{about}: a side of the InternalLink is in another picture");
        assert_eq!(findings(&module), [wanted]);
        assert!(module.pictures[1].links.is_empty(), "{from} {to}");
    }
}

/// Returns an attribute, as the manifest of the column has it.
fn value(name: &str, value: &str) -> String {
    format!("<Attribute Name=\"{name}\" AttributeDataType=\"xs:integer\"><Value>{value}</Value>")
}

#[test]
fn numbers_that_no_picture_has_are_findings() {
    let of = |name: &str, from: &str, to: &str| {
        findings(&replaced(&value(name, from), &value(name, to)))
    };
    for number in ["1e308", "1e11", "-inf", "1e-7"] {
        let what = format!("its X is `{number}`, which is too large or too small for a picture");
        assert_eq!(of("X", "100", number), [format!("Overview/Heater: {what}")]);
    }
    for number in ["1e10", "-1e-6", "-0"] {
        assert_eq!(of("X", "100", number), Vec::<String>::new(), "{number}");
    }
    assert_eq!(
        findings(&replaced(">260,140;130,200<", ">260,140;130,1e308<")),
        [
            "Overview/Interlock: its Edgepath `260,140;130,1e308` has a number that is too large or \
             too small for a picture"
        ]
    );
    let below = "the Width or the Height is below 0";
    assert_eq!(of("Height", "240", "-240"), [format!("Overview: {below}")]);
    assert_eq!(
        of("Width", "60", "-1"),
        [format!("Overview/Heater: {below}")]
    );
    assert_eq!(of("Width", "60", "0"), Vec::<String>::new());
    let module = replaced(&value("Height", "240"), &value("Height", "-240"));
    assert_eq!(overview(&module).size, None);
}

#[test]
fn elements_of_pictures_that_are_left_out_are_findings_with_their_lines() {
    let text = read_own("mtp/column.aml");
    let line = text
        .lines()
        .position(|line| line.contains("MTPHMISUCLib/Picture"));
    let line = line.unwrap() + 1;
    let found = |from: &str, to: &str| -> Vec<String> {
        assert!(text.contains(from), "{from}");
        let module = Module::read(&text.replacen(from, to, 1)).unwrap();
        module.findings.iter().map(ToString::to_string).collect()
    };
    let one = |from: &str, to: &str| -> String {
        let all = found(from, to);
        let [only] = &*all else { panic!("{all:?}") };
        let rest = only.strip_prefix(&format!("line {line}: "));
        rest.unwrap_or_else(|| panic!("{only}")).to_owned()
    };
    assert_eq!(
        one(&value("Width", "320"), &value("Width", "")),
        "Overview: the picture has no Width or no Height"
    );
    assert_eq!(
        one(&value("X", "100"), &value("X", "NaN")),
        "Overview/Heater: its X is `NaN`, which is no number"
    );
    assert_eq!(
        one(&value("Height", "90"), &value("Height", "")),
        "Overview/Heater: the object has no Width or no Height"
    );
    assert_eq!(
        one(">260,140;130,200<", ">260,140;130<"),
        "Overview/Interlock: its Edgepath `260,140;130` is no list of points, as `1,2;3,4`"
    );
    assert_eq!(
        one(
            "\"pic-3-out-c\" RefPartnerSideB",
            "\"gone\" RefPartnerSideB"
        ),
        "Overview: gone - pic-5-1-c: a side of the InternalLink names no port of a picture"
    );
    assert_eq!(
        one(
            "MTPHMISUCLib/Connection/FunctionLine",
            "MTPHMISUCLib/Border"
        ),
        "MTPHMISUCLib/Border: not read (1 in the file)"
    );
    assert_eq!(
        one(
            "\"pic-2-l-c\" RefBaseClassPath=\"MTPHMIICLib/ConnectorInterface/InformationFlowConnector\"",
            "\"x\" RefBaseClassPath=\"MTPHMIICLib/Other\"/><ExternalInterface ID=\"pic-2-l-c\" \
             RefBaseClassPath=\"MTPHMIICLib/ConnectorInterface/MassFlowConnector\""
        ),
        "MTPHMIICLib/Other: not read (1 in the file)"
    );
    let heater = "MTPHMISUCLib/VisualObject\"><Attribute Name=\"RefID\" AttributeDataType=\"xs:string\" \
                  RefAttributeType=\"MTPATLib/IDReferenceType/RefIDAttributeType\"><Value>r-Heater<";
    assert_eq!(
        one(heater, &heater.replace("r-Heater", "r-gone")),
        "Overview/Heater: no data assembly has its RefID `r-gone`, so it shows no values"
    );
}

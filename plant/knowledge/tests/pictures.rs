//! Pictures of modules: their list and their drawings, which are made from the graph.
#![expect(clippy::unwrap_used, clippy::panic, reason = "a test may")]

use std::collections::BTreeMap;
use std::sync::Arc;

use knowledge::{
    HttpEndpoint, Knowledge, KnowledgeSource, PictureFault, QueryLimits, SourceKind,
    vocabulary as v,
};
use mtp::{Module, PictureObject, escaped};
use serde_json::json;
use test_data::read_own;

use super::http::get;

const COLUMN: &str = "urn:ua-bridge:mtp:column";
const STAGE: &str = "urn:ua-bridge:mtp:stage";

fn put(knowledge: &Knowledge, iri: &str, module: &Module) {
    let source = KnowledgeSource::new(SourceKind::Mtp, iri);
    let triples = module.triples(iri, &BTreeMap::new());
    knowledge.replace(&source, &triples, 1).unwrap();
}

fn module(name: &str) -> Module {
    Module::read(&read_own(&format!("mtp/{name}.aml"))).unwrap()
}

/// Returns the graph of a module with a picture, and of a module without.
fn plant() -> (Knowledge, Module) {
    let knowledge = Knowledge::new().unwrap();
    let column = module("column");
    put(&knowledge, COLUMN, &column);
    put(&knowledge, STAGE, &module("stage"));
    (knowledge, column)
}

fn overview(knowledge: &Knowledge) -> String {
    let found = knowledge.pictures(Some(COLUMN)).unwrap();
    let [overview] = &*found else {
        panic!("{found:?}");
    };
    overview.picture.clone()
}

#[test]
fn the_drawing_of_a_picture_is_that_of_its_manifest() {
    let (knowledge, mut column) = plant();
    let drawing = column.pictures[0].svg(&column.assemblies);
    assert!(drawing.contains("<title>Heater (") && drawing.contains("url(#end)"));
    assert_eq!(knowledge.picture_svg(&overview(&knowledge)), Ok(drawing));
    // Layers, and the order of the file within a layer.
    for picture in &mut column.pictures {
        picture.objects.reverse();
        picture.objects[1].layer = -1.5;
        picture.connections.reverse();
        picture.size = None;
    }
    put(&knowledge, COLUMN, &column);
    let drawing = column.pictures[0].svg(&column.assemblies);
    assert_eq!(knowledge.picture_svg(&overview(&knowledge)), Ok(drawing));
}

#[test]
fn pictures_are_listed_with_their_modules() {
    let (knowledge, mut column) = plant();
    let found = knowledge.pictures(None).unwrap();
    let parts = column.pictures[0].objects.len() + column.pictures[0].connections.len();
    let listed = serde_json::to_value(&found).unwrap();
    let expected = json!([{
        "module_name": "Column", "name": "Overview", "module": COLUMN,
        "picture": overview(&knowledge), "parts": parts,
    }]);
    assert_eq!(listed, expected);
    assert_eq!(knowledge.pictures(Some(STAGE)), Ok(Vec::new()));
    for unknown in ["urn:other", "", "no IRI"] {
        let fault = knowledge.pictures(Some(unknown)).unwrap_err();
        assert_eq!(fault, PictureFault::UnknownModule(unknown.to_owned()));
        let fault = knowledge.picture_svg(unknown).unwrap_err();
        assert_eq!(fault, PictureFault::UnknownPicture(unknown.to_owned()));
    }
    assert!(knowledge.picture_svg(COLUMN).is_err(), "it is a module");
    column.pictures.clear();
    put(&knowledge, COLUMN, &column);
    assert_eq!(knowledge.pictures(None), Ok(Vec::new()));
}

#[test]
fn a_picture_that_is_too_large_is_refused() {
    let (knowledge, mut column) = plant();
    let iri = overview(&knowledge);
    let object = column.pictures[0].objects[0].clone();
    let too_large = PictureFault::TooLarge {
        picture: iri.clone(),
    };
    let number = column.pictures[0].connections.len();
    let fits = Knowledge::MOST_PICTURE_PARTS - number;
    for (parts, fits) in [(fits, true), (fits + 1, false)] {
        let objects = (0..parts).map(|number| {
            let mut object = object.clone();
            object.id = format!("object {number}");
            object
        });
        column.pictures[0].objects = objects.collect();
        put(&knowledge, COLUMN, &column);
        let drawn = knowledge.picture_svg(&iri);
        assert_eq!(drawn.as_ref().err(), (!fits).then_some(&too_large));
    }
    for name in [
        "x".repeat(Knowledge::LARGEST_PICTURE + 1),
        "<".repeat(1 << 20),
    ] {
        column.pictures[0].objects = vec![object.clone()];
        column.pictures[0].objects[0].name = name;
        put(&knowledge, COLUMN, &column);
        assert_eq!(knowledge.picture_svg(&iri).as_ref(), Err(&too_large));
    }
}

#[test]
fn an_object_without_an_element_has_no_share_of_the_name_of_another() {
    let (knowledge, mut column) = plant();
    let iri = overview(&knowledge);
    let objects = &mut column.pictures[0].objects;
    let shown = objects.iter().find(|object| object.assembly.is_some());
    let shown = shown.unwrap().clone();
    let mut plain = shown.clone();
    plain.assembly = None;
    let element = shown.assembly.clone().unwrap();
    *objects = vec![shown];
    objects.extend((0..8).map(|number| {
        let id = format!("plain {number}");
        PictureObject {
            id,
            ..plain.clone()
        }
    }));
    let mut assemblies = column.assemblies.iter_mut();
    let assembly = assemblies.find(|assembly| assembly.id == element).unwrap();
    let length = Knowledge::LARGEST_PICTURE / 4;
    assembly.name = "x".repeat(length);
    put(&knowledge, COLUMN, &column);
    let drawn = knowledge.picture_svg(&iri).unwrap();
    assert!(drawn.len() > length, "{}", drawn.len());
}

#[test]
fn the_pictures_of_a_module_are_listed_beside_very_many_others() {
    let knowledge = Knowledge::new().unwrap();
    let source = KnowledgeSource::new(SourceKind::File, "own.ttl");
    let ours = v::PICTURE.trim_end_matches("Picture");
    let others = (0..20_000).map(|number| format!("<urn:other> ua:hasPicture <urn:o{number}> .\n"));
    let modules = (0..20).map(|number| {
        format!(
            "<urn:m{number}> a ua:Module ; ua:hasPicture <urn:p{number}> .
            <urn:p{number}> a ua:Picture .\n"
        )
    });
    let prefix = format!("@prefix ua: <{ours}> .\n");
    let turtle: String = std::iter::once(prefix)
        .chain(others)
        .chain(modules)
        .collect();
    knowledge.replace_turtle(&source, &turtle, 1).unwrap();
    for number in 0..20 {
        let found = knowledge.pictures(Some(&format!("urn:m{number}"))).unwrap();
        let names: Vec<_> = found.iter().map(|one| &*one.picture).collect();
        assert_eq!(names, [format!("urn:p{number}")]);
    }
}

#[test]
fn statements_of_a_user_are_drawn_as_far_as_they_are_a_picture() {
    let knowledge = Knowledge::new().unwrap();
    let source = KnowledgeSource::new(SourceKind::File, "own.ttl");
    let ours = v::PICTURE.trim_end_matches("Picture");
    let turtle = format!(
        "@prefix ua: <{ours}> . @prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> .
        <urn:m> a ua:Module ; ua:hasPicture <urn:p> , <urn:other> , \"text\" .
        <urn:p> a ua:Picture ; ua:hasPicturePart <urn:a> , <urn:b> , 5 , [] .
        <urn:a> rdfs:label \"tank\" ; ua:left \"INF\" , 4 ; ua:top 5 ; ua:width \"wide\" ; ua:showsElement <urn:none> .
        <urn:b> a ua:PictureConnection ; ua:edgePath \"no path\" ."
    );
    knowledge.replace_turtle(&source, &turtle, 1).unwrap();
    let found = knowledge.pictures(None).unwrap();
    let names: Vec<_> = found.iter().map(|one| (&*one.picture, one.parts)).collect();
    assert_eq!(names, [("urn:p", 4)]);
    let svg = knowledge.picture_svg("urn:p").unwrap();
    assert!(svg.contains("<text x=\"4\" y=\"5\">tank</text>"), "{svg}");
    assert!(svg.contains("points=\"\""), "{svg}");
}

#[tokio::test]
async fn pictures_are_listed_and_drawn_over_http() {
    let (knowledge, mut column) = plant();
    let hostile = "</title><script>alert(1)</script>\" & 'x'";
    column.pictures[0].name = hostile.to_owned();
    column.pictures[0].objects[0].name = hostile.to_owned();
    put(&knowledge, COLUMN, &column);
    let page = Arc::new(|_: &str| None);
    let address = "127.0.0.1:0".parse().unwrap();
    let knowledge = Arc::new(knowledge);
    let endpoint = HttpEndpoint::bind(address, knowledge, QueryLimits::default(), page).await;
    let endpoint = endpoint.unwrap();
    let at = endpoint.address();
    let listed = get(at, "/pictures", "*/*").await.json();
    assert_eq!(listed["pictures"][0]["name"], hostile);
    let of_stage = get(at, &format!("/pictures?module={}", escaped(STAGE)), "*/*").await;
    assert_eq!(of_stage.json(), json!({ "pictures": [] }));
    let iri = listed["pictures"][0]["picture"].as_str().unwrap();
    let drawn = get(at, &format!("/picture/{}", escaped(iri)), "*/*").await;
    assert_eq!(drawn.status, 200);
    assert!(drawn.head.contains("content-type: image/svg+xml"));
    assert!(drawn.head.contains("default-src 'none'"), "{}", drawn.head);
    assert!(!drawn.body.contains("<script"), "{}", drawn.body);
    assert!(drawn.body.contains("&lt;script&gt;"), "{}", drawn.body);
    let hostile = escaped(hostile);
    for (path, code) in [
        (format!("/picture/{hostile}"), (404, "unknown")),
        ("/picture/".to_owned(), (404, "unknown")),
        ("/picture/%zz".to_owned(), (400, "malformed")),
        (format!("/picture/{}", escaped(COLUMN)), (404, "unknown")),
        (format!("/pictures?module={hostile}"), (404, "unknown")),
    ] {
        let (status, code_of) = get(at, &path, "*/*").await.code();
        assert_eq!((status, &*code_of), code, "{path}");
    }
}

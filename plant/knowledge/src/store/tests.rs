use oxigraph::sparql::CancellationToken;

use super::*;

#[test]
fn literals_that_are_not_canonical_stay_when_their_source_is_replaced() {
    let knowledge = Knowledge::new().unwrap();
    let source = KnowledgeSource::new(SourceKind::File, "times.ttl");
    let literals = [
        r#""2026-11-27T10:00:00.120Z"^^xsd:dateTime"#,
        r#""2026-11-27T10:00:01.000Z"^^xsd:dateTime"#,
        r#""007"^^xsd:integer"#,
        r#""1.50"^^xsd:decimal"#,
        r#""1e0"^^xsd:double"#,
        r#""1"^^xsd:boolean"#,
        r#""P0Y14M"^^xsd:duration"#,
    ];
    let mut turtle = "@prefix xsd: <http://www.w3.org/2001/XMLSchema#> .\n".to_owned();
    for (at, literal) in (1..).zip(literals) {
        let line = format!("<urn:example:{at}> <urn:example:is> {literal} .\n");
        turtle.push_str(&line);
        // Each version repeats the statements of the version before.
        knowledge.replace_turtle(&source, &turtle, 0).unwrap();
        let own = named(&source.graph()).unwrap();
        for graph in [own.as_ref().into(), GraphNameRef::DefaultGraph] {
            let found = knowledge
                .store()
                .quads_for_pattern(None, None, None, Some(graph))
                .count();
            assert_eq!(found, at, "{literal}");
        }
    }
    // A statement that is no longer in the file is removed, for any form of its literal.
    knowledge
        .replace_turtle(&source, "<urn:a> <urn:b> <urn:c> .", 0)
        .unwrap();
    assert_eq!(knowledge.store().len().unwrap(), 2);
}

/// Returns the statements of a run.
fn of_run(run: usize) -> String {
    let all = 0..100;
    all.map(|at| format!("<urn:run:{run}> <urn:b> <urn:{run}:{at}> .\n"))
        .collect()
}

/// Adds and removes a run of 100 statements.
fn run(knowledge: &Knowledge, run: usize) {
    let source = KnowledgeSource::new(SourceKind::Run, &run.to_string());
    let turtle = of_run(run);
    knowledge.replace_turtle(&source, &turtle, 0).unwrap();
    assert!(knowledge.remove(&source).unwrap());
}

#[test]
fn removed_statements_do_not_pile_up_in_the_store() {
    let knowledge = Knowledge::new().unwrap();
    let stays = KnowledgeSource::new(SourceKind::File, "stays.ttl");
    knowledge.replace_turtle(&stays, &of_run(0), 0).unwrap();
    let first = knowledge.store();
    let runs = 3 * MOST_REMOVED / 100;
    let mut copies = 0;
    for number in 1..=runs {
        let before = knowledge.written().removed;
        run(&knowledge, number);
        let removed = knowledge.written().removed;
        assert!(removed > before, "a change copies the store");
        let is_copied = knowledge.compact().unwrap();
        assert_eq!(is_copied, removed > MOST_REMOVED, "{removed}");
        copies += usize::from(is_copied);
        let removed = knowledge.written().removed;
        assert!(removed <= MOST_REMOVED, "{removed}");
        assert!(!knowledge.compact().unwrap());
    }
    assert_eq!(copies, 2);
    // The statements are in another store. A reader that holds the first store does not see later
    // changes.
    let kept = knowledge.store();
    assert_eq!(kept.len().unwrap(), 200);
    let more = KnowledgeSource::new(SourceKind::File, "more.ttl");
    knowledge.replace_turtle(&more, &of_run(1), 0).unwrap();
    assert_eq!(kept.len().unwrap(), 400);
    assert_eq!(first.len().unwrap(), 200);
    let names: Vec<String> = knowledge.sources().into_iter().map(|of| of.name).collect();
    assert!(names.contains(&stays.name), "{names:?}");
}

#[test]
fn a_store_that_nobody_compacts_does_not_grow_without_end() {
    let knowledge = Knowledge::new().unwrap();
    let stays = KnowledgeSource::new(SourceKind::File, "stays.ttl");
    knowledge.replace_turtle(&stays, &of_run(0), 0).unwrap();
    let most = MOST_OF_KEPT * (100 + MOST_REMOVED);
    let mut copies = 0;
    for number in 1..=2 * most / 100 {
        let before = knowledge.written().removed;
        run(&knowledge, number);
        let removed = knowledge.written().removed;
        copies += usize::from(removed < before);
        assert!(removed <= most + 200, "{removed}");
    }
    assert_eq!(copies, 1);
    assert_eq!(knowledge.store().len().unwrap(), 200);
}

#[test]
fn a_change_during_a_copy_is_kept() {
    let knowledge = Knowledge::new().unwrap();
    knowledge.written().removed = MOST_REMOVED + 1;
    let first = knowledge.store();
    let mut tries = 0;
    let is_copied = knowledge.compact_with(&mut || {
        tries += 1;
        // The rules change statements, too.
        if tries == 2 {
            knowledge.set_rules(true).unwrap();
        } else {
            let source = KnowledgeSource::new(SourceKind::Run, &tries.to_string());
            knowledge
                .replace_turtle(&source, &of_run(tries), 0)
                .unwrap();
        }
    });
    // The copy after three tries is made while changes wait.
    assert_eq!((is_copied.unwrap(), tries), (true, COPIES));
    assert_eq!(first.len().unwrap(), 400);
    assert_eq!(knowledge.store().len().unwrap(), 400);
    assert_eq!(knowledge.written().removed, 0);
    let source = KnowledgeSource::new(SourceKind::Run, "1");
    assert!(knowledge.remove(&source).unwrap());
    assert_eq!(first.len().unwrap(), 400, "it is another store");
}

#[test]
fn statements_of_a_refused_change_count_as_removed() {
    let knowledge = Knowledge::new().unwrap();
    let token = CancellationToken::new();
    let update = |number: usize, rest: &str| {
        let text = format!("INSERT DATA {{ {} }} {rest}", of_run(number));
        let update = crate::update::read(&text).unwrap();
        knowledge.update(&update, &token, 0)
    };
    assert!(update(1, "").is_ok());
    assert_eq!(knowledge.written().removed, 0);
    assert!(update(2, "; CLEAR GRAPH <urn:ua-bridge:graph:file:x>").is_err());
    assert_eq!(knowledge.written().removed, 100);
    assert!(update(3, "").is_ok());
    assert_eq!(knowledge.written().removed, 100);
    assert_eq!(knowledge.store().len().unwrap(), 400);
}

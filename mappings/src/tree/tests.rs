use super::*;

fn parse(text: &str) -> Result<Rc<YamlNode<'_>>, YamlFault> {
    super::parse(text, 0, &|_| None).map(|tree| tree.root)
}
use proptest::prelude::*;

fn map<'n>(node: &'n YamlNode<'n>) -> Vec<(&'n str, &'n YamlNode<'n>)> {
    let YamlKind::Map(pairs) = &node.kind else {
        panic!("{node:?}")
    };
    pairs
        .iter()
        .map(|(key, value)| match &key.kind {
            YamlKind::Scalar(text) => (&**text, &**value),
            YamlKind::Null | YamlKind::List(_) | YamlKind::Map(_) => panic!("{key:?}"),
        })
        .collect()
}

fn at(line: usize, column: usize, len: usize) -> TextSpan {
    TextSpan {
        file: 0,
        line,
        column,
        len,
    }
}

#[test]
fn every_node_knows_its_place_in_characters() {
    let root = parse("# c\nspaces:\n  - {id: 1, ros: \"ä1\"}\nname: 'x'\nnote: |\n  long\n  er\n")
        .unwrap();
    let root = map(&root);
    assert_eq!(root[1].1.place, at(4, 7, 3));
    let YamlKind::List(items) = &root[0].1.kind else {
        panic!()
    };
    assert_eq!((items[0].place.line, items[0].place.column), (3, 5));
    let item = map(&items[0]);
    assert_eq!(item[0].1.place, at(3, 10, 1));
    assert_eq!(item[1].1.place, at(3, 18, 4));
    assert!(matches!(&root[2].1.kind, YamlKind::Scalar(text) if text == "long\ner\n"));
}

#[test]
fn repeated_keys_are_kept() {
    let root = parse("a: 1\na: 2\n").unwrap();
    assert_eq!(map(&root).len(), 2);
}

#[test]
fn nothing_is_null_and_quotes_make_a_text() {
    let root = parse("a:\nb: ~\nc: ''\nd: 'null'\n").unwrap();
    let kinds: Vec<&str> = map(&root)
        .iter()
        .map(|(_, node)| node.kind.name())
        .collect();
    assert_eq!(
        kinds,
        ["nothing", "nothing", "a single value", "a single value"]
    );
    for text in ["", "# only a comment\n", "---\n", "\u{feff}# with a mark\n"] {
        assert!(
            matches!(parse(text).unwrap().kind, YamlKind::Null),
            "{text:?}"
        );
    }
}

#[test]
fn variables_stand_in_values_and_are_written_with_braces() {
    let messages = |text: &str| {
        let tree = super::parse(text, 0, &|_| Some("x".to_owned())).unwrap();
        let messages = tree.faults.into_iter();
        messages.map(|fault| fault.message).collect::<Vec<_>>()
    };
    assert_eq!(messages("a: ${X}\nb: '$X'\nc: costs $5\nd: $\n"), [""; 0]);
    assert_eq!(messages("${X}: 1\n").len(), 1);
    assert_eq!(messages("a: {'${X}': 1}\n").len(), 1);
    assert_eq!(messages("a: $IFACE\n").len(), 1);
    assert_eq!(messages("a: $(IFACE)\n").len(), 1);
}

#[test]
fn an_alias_shares_the_node_it_names() {
    let root = parse("a: &x {b: 1}\nc: *x\n").unwrap();
    let root = map(&root);
    assert!(std::ptr::eq(root[0].1, root[1].1));
}

#[test]
fn a_tower_of_aliases_is_refused_at_its_height_not_at_its_size() {
    let mut text = "a0: &a0 [x]\n".to_owned();
    for n in 1..40 {
        let below = n - 1;
        text += &format!("a{n}: &a{n} [*a{below}, *a{below}, *a{below}, *a{below}]\n");
    }
    let fault = parse(&text).unwrap_err();
    assert_eq!((fault.code, fault.place.line), (Code::TooLarge, MAX_DEPTH));
}

#[test]
fn what_is_not_read_is_named_with_its_place() {
    for (text, line, word) in [
        ("a: [1, 2\nb: 3\n", 2, ""),
        ("a: 1\n---\nb: 2\n", 2, "second document"),
        ("a: !!str 1\n", 1, "tag `!!str`"),
        ("a: !degrees 1\n", 1, "tag `!degrees`"),
        ("a: *b\n", 1, "no `&b`"),
        ("a: &a [*a]\n", 1, "within the node it names"),
    ] {
        let fault = parse(text).unwrap_err();
        assert_eq!(
            (fault.code, fault.place.line),
            (Code::Syntax, line),
            "{text}: {fault:?}"
        );
        assert!(fault.message.contains(word), "{fault:?}");
    }
    let late = parse("a:\n  b: 1\n\tc: 2\n").unwrap_err();
    assert!(
        late.place.line == 3 && late.help.unwrap().contains("tabs"),
        "{late:?}"
    );
    let flow = parse("a: {b: ${X}}\n").unwrap_err();
    assert!(flow.help.unwrap().contains("quotes"), "{flow:?}");
    let tab = parse("a:\n\tb: 1\n").unwrap_err();
    assert!(tab.help.unwrap().contains("tabs"), "{tab:?}");
}

#[test]
fn what_is_too_large_is_refused() {
    let code = |text: &str| parse(text).unwrap_err().code;
    assert_eq!(code(&"#".repeat(MAX_BYTES + 1)), Code::TooLarge);
    assert_eq!(
        code(&format!("[{}]", "1,".repeat(MAX_NODES))),
        Code::TooLarge
    );
    for deep in [
        "[".repeat(100_000),
        "- ".repeat(100_000),
        "{a: ".repeat(100_000),
    ] {
        assert!(parse(&deep).is_err());
    }
    assert!(
        parse(&format!(
            "{}{}",
            "[".repeat(MAX_DEPTH),
            "]".repeat(MAX_DEPTH)
        ))
        .is_ok()
    );
}

proptest! {
    #[test]
    fn any_text_is_a_tree_or_a_fault(text in "[-a-c:{}\\[\\],&*!|>'\"# \n\t~?%@]{0,60}|\\PC{0,60}") {
        if let Err(fault) = parse(&text) {
            prop_assert!(fault.place.line >= 1 && fault.place.column >= 1 && fault.place.len >= 1);
        }
    }
}

//! The rules of OWL 2 RL: the derived statements after every change are those of a plain
//! application of the rules until nothing follows any more.
#![expect(clippy::unwrap_used, reason = "a test may")]

use std::collections::{BTreeMap, BTreeSet};

use knowledge::{Knowledge, KnowledgeSource, QUESTIONS, SourceKind};

const PREFIXES: &str = "@prefix rdf: <http://www.w3.org/1999/02/22-rdf-syntax-ns#> . \
    @prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> . \
    @prefix owl: <http://www.w3.org/2002/07/owl#> . @prefix : <urn:p:> .\n";
const DERIVED: &str = "urn:ua-bridge:graph:derived";

type Statement = [String; 3];
type Statements = BTreeSet<Statement>;

fn iri(name: &str) -> String {
    let (prefix, rest) = name.split_once(':').unwrap();
    let base = match prefix {
        "rdf" => "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
        "rdfs" => "http://www.w3.org/2000/01/rdf-schema#",
        "owl" => "http://www.w3.org/2002/07/owl#",
        _ => "urn:p:",
    };
    format!("<{base}{rest}>")
}

fn statement(text: &str) -> Statement {
    let terms: Vec<String> = text.split(' ').map(iri).collect();
    terms.try_into().unwrap()
}

/// Applies the rules to all statements until nothing is new.
fn closure(stated: &Statements) -> Statements {
    let [kind, sub, sub_property] = ["rdf:type", "rdfs:subClassOf", "rdfs:subPropertyOf"].map(iri);
    let [equal, equal_property, inverse] = [
        "owl:equivalentClass",
        "owl:equivalentProperty",
        "owl:inverseOf",
    ]
    .map(iri);
    let [domain, range, transitive, symmetric] = [
        "rdfs:domain",
        "rdfs:range",
        "owl:TransitiveProperty",
        "owl:SymmetricProperty",
    ]
    .map(iri);
    let mut all = stated.clone();
    loop {
        let mut new = Statements::new();
        let mut add = |s: &str, p: &str, o: &str| {
            new.insert([s.to_owned(), p.to_owned(), o.to_owned()]);
        };
        for [s, p, o] in &all {
            for (equivalence, below) in [(&equal, &sub), (&equal_property, &sub_property)] {
                if p == equivalence {
                    add(s, below, o);
                    add(o, below, s);
                }
            }
            for [s2, p2, o2] in &all {
                let is_chain = p == p2 && o == s2;
                if is_chain && (*p == sub || *p == sub_property) {
                    add(s, p, o2);
                }
                if *p == kind && *p2 == sub && o == s2 {
                    add(s, &kind, o2);
                }
                if *p2 == sub_property && s2 == p {
                    add(s, o2, o);
                }
                if *p2 == domain && s2 == p {
                    add(s, &kind, o2);
                }
                if *p2 == range && s2 == p {
                    add(o, &kind, o2);
                }
                if *p2 == inverse && s2 == p {
                    add(o, o2, s);
                }
                if *p2 == inverse && o2 == p {
                    add(o, s2, s);
                }
                if *p2 == kind && s2 == p && *o2 == symmetric {
                    add(o, p, s);
                }
                let is_transitive = || all.contains(&[p.clone(), kind.clone(), transitive.clone()]);
                if is_chain && is_transitive() {
                    add(s, p, o2);
                }
            }
        }
        let before = all.len();
        all.extend(new);
        if all.len() == before {
            return all;
        }
    }
}

/// Returns the statements of the derived graph that no source states, without what is above
/// itself.
fn derived(knowledge: &Knowledge, stated: &Statements) -> Statements {
    let mut quads = Vec::new();
    if knowledge
        .write_quads(Some(DERIVED), &mut quads)
        .unwrap()
        .is_none()
    {
        return Statements::new();
    }
    let text = String::from_utf8(quads).unwrap();
    let lines = text.lines().map(|line| {
        let terms: Vec<String> = line.split(' ').take(3).map(str::to_owned).collect();
        <Statement>::try_from(terms).unwrap()
    });
    let of_hierarchies = [iri("rdfs:subClassOf"), iri("rdfs:subPropertyOf")];
    lines
        .inspect(|one| {
            assert!(
                of_hierarchies.contains(&one[1]) || !stated.contains(one),
                "{one:?} is stated"
            );
        })
        .filter(|one| !stated.contains(one) && !is_of_itself(one))
        .collect()
}

fn is_of_itself([s, p, o]: &Statement) -> bool {
    s == o && [iri("rdfs:subClassOf"), iri("rdfs:subPropertyOf")].contains(p)
}

/// The statements of the plant in the tests.
const PARTS: [&str; 26] = [
    ":Gripper rdfs:subClassOf :Tool",
    ":Tool rdfs:subClassOf :Device",
    ":Werkzeug owl:equivalentClass :Tool",
    ":hasPart rdf:type owl:TransitiveProperty",
    ":hasPart owl:inverseOf :isPartOf",
    ":hasScrew rdfs:subPropertyOf :hasPart",
    ":hasPart rdfs:subPropertyOf :relatesTo",
    ":mounts owl:equivalentProperty :hasPart",
    ":touches rdf:type owl:SymmetricProperty",
    ":touches rdfs:subPropertyOf :near",
    ":near rdf:type owl:TransitiveProperty",
    ":hasPart rdfs:domain :Assembly",
    ":relatesTo rdfs:range :Thing",
    ":Assembly rdfs:subClassOf :Device",
    ":cell :hasPart :robot",
    ":robot :hasPart :hand",
    ":hand :mounts :gripper",
    ":gripper :hasScrew :screw",
    ":screw :isPartOf :box",
    ":robot :touches :table",
    ":table :touches :floor",
    ":floor :near :robot",
    ":gripper rdf:type :Gripper",
    ":robot rdf:type :Device",
    ":screw :relatesTo :cell",
    ":table rdf:type :Werkzeug",
];

/// Returns numbers that look random and are the same in each run.
fn numbers() -> impl FnMut() -> usize {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        usize::try_from(state % 1_000_003).unwrap()
    }
}

#[test]
fn derived_statements_follow_each_change_of_a_source() {
    let knowledge = Knowledge::new().unwrap();
    knowledge.set_rules(true).unwrap();
    let mut next = numbers();
    let mut sources: BTreeMap<usize, BTreeSet<&str>> = BTreeMap::new();
    let mut most = 0;
    for step in 0..400 {
        let name = next() % 4;
        let source = KnowledgeSource::new(SourceKind::File, &format!("{name}.ttl"));
        if next().is_multiple_of(6) {
            sources.remove(&name);
            knowledge.remove(&source).unwrap();
        } else {
            let parts = sources.entry(name).or_default();
            for _ in 0..3 {
                let part = PARTS[next() % PARTS.len()];
                if !parts.remove(part) {
                    parts.insert(part);
                }
            }
            let mut turtle = PREFIXES.to_owned();
            turtle.extend(parts.iter().map(|part| format!("{part} .\n")));
            knowledge.replace_turtle(&source, &turtle, 1).unwrap();
        }
        let stated: Statements = sources
            .values()
            .flatten()
            .map(|part| statement(part))
            .collect();
        let mut expected = closure(&stated);
        expected.retain(|one| !stated.contains(one) && !is_of_itself(one));
        most = most.max(expected.len());
        assert_eq!(
            derived(&knowledge, &stated),
            expected,
            "step {step}: {stated:#?}"
        );
        let of_status = knowledge.sources();
        let count = of_status.iter().find(|one| one.kind == SourceKind::Derived);
        let mut quads = Vec::new();
        knowledge.write_quads(Some(DERIVED), &mut quads).unwrap();
        let lines = quads.split(|byte| *byte == b'\n').count() - 1;
        assert_eq!(count.map_or(0, |one| one.statements), lines);
    }
    assert!(most > 40, "the test derives {most} statements at most");
}

#[test]
fn the_rules_are_switched_while_the_program_runs() {
    let knowledge = Knowledge::new().unwrap();
    let source = KnowledgeSource::new(SourceKind::File, "all.ttl");
    let turtle = format!("{PREFIXES}{} .", PARTS.join(" .\n"));
    knowledge.replace_turtle(&source, &turtle, 1).unwrap();
    let stated: Statements = PARTS.iter().map(|part| statement(part)).collect();
    let is_device = statement(":gripper rdf:type :Device");
    let is_below = statement(":Gripper rdfs:subClassOf :Device");
    let off = derived(&knowledge, &stated);
    assert!(off.contains(&is_below) && !off.contains(&is_device));
    knowledge.set_rules(true).unwrap();
    let on = derived(&knowledge, &stated);
    assert!(on.contains(&is_below) && on.contains(&is_device));
    assert_eq!(knowledge.rules(), "on");
    knowledge.set_rules(false).unwrap();
    assert_eq!(derived(&knowledge, &stated), off);
}

#[test]
fn named_questions_have_the_same_answers_with_the_rules() {
    let knowledge = Knowledge::new().unwrap();
    let module = mtp::Module::read(&test_data::read_own("mtp/stage.aml")).unwrap();
    let stage = KnowledgeSource::new(SourceKind::Mtp, "stage");
    let triples = module.triples("urn:m", &BTreeMap::new());
    knowledge.replace(&stage, &triples, 1).unwrap();
    let more = format!(
        "{PREFIXES} @prefix css: <http://www.w3id.org/hsu-aut/css#> .
        @prefix cask: <http://www.w3id.org/hsu-aut/cask#> . @prefix ua: <urn:ua-bridge:plant#> .
        cask:ProvidedCapability rdfs:subClassOf css:Capability .
        cask:RequiredCapability rdfs:subClassOf css:Capability .
        css:requiresCapability rdfs:domain css:Process ; rdfs:range css:Capability .
        css:isRealizedBySkill rdfs:domain css:Capability ; rdfs:range css:Skill .
        :Hold rdfs:subClassOf css:Capability . :Grasp rdfs:subClassOf :Hold .
        :c a ua:Component ; rdfs:label \"gripper\" ; css:providesSkill :s .
        :s a :GraspType ; rdfs:label \"Grasp\" ; ua:endpoint \"opc.tcp://h:1\" ; ua:nodeId \"i=1\" .
        :GraspType rdfs:subClassOf :SkillType ; ua:browseName \"GraspType\" ; ua:nodeNamespace \"urn:p\" .
        :SkillType rdfs:subClassOf :SkillType ; ua:browseName \"SkillType\" ; ua:nodeNamespace \"urn:p\" .
        :k a :Grasp , cask:ProvidedCapability ; css:isRealizedBySkill :s .
        :p a css:Process ; rdfs:label \"p\" ; ua:hasStep :p1 .
        :p1 rdfs:label \"hold\" ; ua:position 1 ; css:requiresCapability :n .
        :n a cask:RequiredCapability , :Hold ; ua:role \"tool\" ."
    );
    let file = KnowledgeSource::new(SourceKind::File, "more.ttl");
    knowledge.replace_turtle(&file, &more, 1).unwrap();
    let ask = |name: &str| {
        let rows = knowledge.ask(name, &[]).unwrap().rows.into_iter();
        let mut rows: Vec<_> = rows.map(|row| format!("{row:?}")).collect();
        rows.sort();
        rows
    };
    let questions = || {
        QUESTIONS
            .iter()
            .filter(|question| question.name != "sources")
    };
    let before: Vec<_> = questions().map(|question| ask(question.name)).collect();
    assert!(ask("process-steps").len() == 1 && ask("candidates").len() > 1);
    knowledge.set_rules(true).unwrap();
    for (question, before) in questions().zip(before) {
        assert_eq!(ask(question.name), before, "{}", question.name);
    }
}

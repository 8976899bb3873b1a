//! A mapping of what is there: from live graphs, from a server, from NodeSets.

mod calls;
mod known;
mod merge;
mod plan;
mod render;
mod topics;
mod yaml;

use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read as _, Write as _};
use std::ops::Range;
use std::os::unix::fs::{MetadataExt as _, fchown};
use std::path::{Path, PathBuf};
use std::time::Duration;

use mappings::{Checked, Code, Diagnostic, Mapping, SpaceId};
use serde::Serialize;
use type_files::Disk;

use crate::arguments::Init;
use crate::exit::Failure;
use crate::report;
use crate::survey::{self, Graph, Nodes, look};
use known::Known;
use plan::{Plan, Wishes};

pub(crate) fn init(arguments: &Init) -> Result<(), Failure> {
    let asked = [
        arguments.ros1.is_none(),
        arguments.ros2.is_empty(),
        arguments.nodeset.is_empty(),
        arguments.opcua.is_empty(),
    ];
    if asked.iter().all(|nothing| *nothing) {
        return Err(Failure::Usage(
            "nothing to look at: give one or several of --ros1, --ros2, --nodeset FILE, --opcua URL"
                .to_owned(),
        ));
    }
    let existing = match &arguments.output {
        Some(file) => existing(file)?,
        None => None,
    };
    let mut known = match &existing {
        Some((mapping, text)) => Known::of(mapping.clone(), text),
        None => Known::default(),
    };
    let found = Found::look(arguments, &known.mapping)?;
    let wishes = Wishes {
        namespace: &arguments.namespace,
        transforms: arguments.tf,
    };
    let mut plan = Plan::new(&found.graphs, &found.nodes, &wishes, &mut known);
    let file = arguments.output.as_deref().unwrap_or_default();
    let text = match &existing {
        Some((mapping, text)) => added(file, (text, mapping), &mut plan)?,
        None => written(file, &found.places, &mut plan)?,
    };
    put(
        arguments,
        existing.as_ref().map(|(_, text)| text.as_str()),
        &text,
        &plan,
    )
}

/// What was looked at.
struct Found {
    graphs: Vec<Graph>,
    nodes: Vec<Nodes>,
    /// For people, in their order.
    places: Vec<String>,
}

impl Found {
    fn look(arguments: &Init, known: &Mapping) -> Result<Self, Failure> {
        let mut found = Self {
            graphs: Vec::new(),
            nodes: Vec::new(),
            places: Vec::new(),
        };
        if let Some(uri) = &arguments.ros1 {
            let uri = uri.clone().unwrap_or_else(survey::ros1::master_uri);
            let live = look(survey::ros1::survey(&uri))?;
            found.places.push(format!("ROS 1 master {uri}"));
            found.graphs.push(Graph {
                space: SpaceId::ROS1,
                domain: None,
                live,
            });
        }
        for domain in domains(arguments)? {
            let space = space_of(domain, known, &found.graphs)?;
            let wait = Duration::from_secs(arguments.wait.into());
            let live = look(survey::ros2::survey(domain, wait))?;
            found.places.push(format!("DDS domain {domain}"));
            found.graphs.push(Graph {
                space,
                domain: Some(domain),
                live,
            });
        }
        for url in &arguments.opcua {
            found.add(look(survey::opcua::survey(url))?);
        }
        for file in &arguments.nodeset {
            found.add(survey::nodeset::survey(file)?);
        }
        Ok(found)
    }

    fn add(&mut self, nodes: Nodes) {
        self.places.push(nodes.place.clone());
        self.nodes.push(nodes);
    }
}

/// Those asked for, each once, in their order.
fn domains(arguments: &Init) -> Result<Vec<u16>, Failure> {
    let mut domains = Vec::new();
    for asked in &arguments.ros2 {
        let variable = std::env::var("ROS_DOMAIN_ID").ok();
        let domain = match (asked, variable.as_deref().map(str::trim)) {
            (Some(domain), _) => *domain,
            (None, None | Some("")) => 0,
            (None, Some(text)) => text
                .parse()
                .ok()
                .filter(|domain| *domain <= 232)
                .ok_or_else(|| {
                    Failure::Usage(format!("ROS_DOMAIN_ID is `{text}`: it is 0 to 232"))
                })?,
        };
        if !domains.contains(&domain) {
            domains.push(domain);
        }
    }
    domains.sort_unstable();
    Ok(domains)
}

/// The space of a domain: the one the mapping gives it, that of its number, or for domains 0 and 1 a free one.
fn space_of(domain: u16, known: &Mapping, graphs: &[Graph]) -> Result<SpaceId, Failure> {
    let taken = |space: &SpaceId| graphs.iter().any(|graph| graph.space == *space);
    if let Some(space) = known.space_of_domain(domain).filter(|space| !taken(space)) {
        return Ok(space);
    }
    let free = |space: &SpaceId| known.space(*space).is_none() && !taken(space);
    let mut spaces = (FIRST_FREE..=232)
        .chain(2..FIRST_FREE)
        .filter_map(SpaceId::new);
    spaces.find(free).ok_or_else(|| {
        Failure::Unconfigured("no ROS 2 space is left for another domain".to_owned())
    })
}

/// The mapping in the file; `None` where there is none.
fn existing(file: &str) -> Result<Option<(Mapping, String)>, Failure> {
    let bytes = match bytes_of(file) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(Failure::reading(file, &error)),
    };
    let text = String::from_utf8(bytes)
        .map_err(|_| Failure::Io(format!("{file} is there and is no text; it stays as it is")))?;
    let mut checked = Mapping::from_text(&text, file, &Disk);
    match checked.mapping.take() {
        Some(mapping) => Ok(Some((mapping, text))),
        None => Err(Failure::Unconfigured(format!(
            "{}\n{file} is there and cannot run, so nothing is added to it; it stays as it is",
            checked.render_all().trim_end()
        ))),
    }
}

fn bytes_of(file: &str) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    File::open(file)?.take(MOST).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// A document of its own.
fn written(file: &str, places: &[String], plan: &mut Plan) -> Result<String, Failure> {
    settled(file, plan, |plan| {
        let mut lines = render::head(places);
        let spaces = "The ROS sides. 1 is ROS 1, others are DDS domains; 0, the OPC UA side, is always there.";
        section(&mut lines, spaces, "spaces", render::spaces(plan, "  "));
        lines.extend(render::network(plan));
        let namespaces = "What the indexes in node ids mean. The URI counts: check --environment compares it with the server's.";
        section(
            &mut lines,
            namespaces,
            "namespaces",
            render::namespaces(plan, "  "),
        );
        let servers = "Servers that exist already: ua-server is their client, and a value is bad while its server is away. Their best security\n\
             # is taken that both sides know; say `security`, `user` and `password` where that is not enough.";
        section(
            &mut lines,
            servers,
            "servers",
            render::servers(plan, "  "),
        );
        let variables = render::variables(plan, "  ");
        if !variables.lines.is_empty() {
            lines.extend(
                [
                    "",
                    "# `origin` is the space that produces the value: there its topic is read, on the other sides it is written.",
                ]
                .map(str::to_owned),
            );
            // A list of nothing but comments is none.
            let any = plan.entries.iter().any(|entry| entry.faulty.is_none());
            lines.push(if any { "variables:" } else { "variables: []" }.to_owned());
        }
        let variables_at = lines.len();
        lines.extend(variables.lines);
        let (calls, entries) = calls::render(&plan.calls, &plan.untyped, "  ");
        if !calls.is_empty() {
            lines.extend(CALLS.map(str::to_owned));
        }
        let calls_at = lines.len();
        lines.extend(calls);
        lines.push(String::new());
        Some(Rendered {
            text: lines.join("\n"),
            variables: (variables_at, variables.entries),
            calls: (calls_at, entries),
        })
    })
}

/// What stands before the calls of a document of its own.
const CALLS: [&str; 5] = [
    "",
    "# What one space executes and the others ask for: there each has its name in the space, as /ua_1_2_61, or the one that a",
    "# binding of that space says, as `ros: [{service: /a, type: std_srvs/SetBool}, {space: 2, service: /b, type: std_srvs/SetBool}]`.",
    "# An action takes five numbers. Requests of other hosts are executed with `open: true`.",
    "calls:",
];

fn section(lines: &mut Vec<String>, title: &str, key: &str, block: Vec<String>) {
    if !block.is_empty() {
        lines.extend([String::new(), format!("# {title}"), format!("{key}:")]);
        lines.extend(block);
    }
}

/// The document with what is new in it.
fn added(file: &str, (text, before): (&str, &Mapping), plan: &mut Plan) -> Result<String, Failure> {
    let merged = settled(file, plan, |plan| {
        let mut merged = text.to_owned();
        let indent = |key: &str| merge::indent(text, key);
        for (key, block) in [
            ("spaces", render::spaces(plan, &indent("spaces"))),
            (
                "namespaces",
                render::namespaces(plan, &indent("namespaces")),
            ),
            ("servers", render::servers(plan, &indent("servers"))),
        ] {
            if !block.is_empty() {
                (merged, _) = merge::append(&merged, key, &block)?;
            }
        }
        let variables = render::variables(plan, &indent("variables"));
        let (calls, call_entries) = calls::render(&plan.calls, &plan.untyped, &indent("calls"));
        let (mut variables_at, mut calls_at) = (0, 0);
        if !variables.lines.is_empty() {
            (merged, variables_at) = merge::append(&merged, "variables", &variables.lines)?;
        }
        if !calls.is_empty() {
            let before = merged.lines().count();
            (merged, calls_at) = merge::append(&merged, "calls", &calls)?;
            if calls_at <= variables_at {
                variables_at += merged.lines().count() - before;
            }
        }
        Some(Rendered {
            text: merged,
            variables: (variables_at, variables.entries),
            calls: (calls_at, call_entries),
        })
    })?;
    let active = plan.entries.iter().filter(|entry| entry.faulty.is_none());
    let active_calls = plan.calls.iter().filter(|call| call.faulty.is_none());
    let kept = Mapping::from_text(&merged, file, &Disk)
        .mapping
        .is_some_and(|after| {
            after.variables().len() == before.variables().len() + active.count()
                && before
                    .variables()
                    .iter()
                    .all(|one| after.variables().contains(one))
                && after.calls().len() == before.calls().len() + active_calls.count()
                && before.calls().iter().all(|one| after.calls().contains(one))
        });
    if kept { Ok(merged) } else { Err(unmergeable()) }
}

fn unmergeable() -> Failure {
    Failure::Unconfigured(
        "nothing can be put into the file as it is written: have each of `spaces`, `namespaces`, `servers`, `variables` and `calls` \
         on lines of their own below the key, not in brackets or braces; it stays as it is"
            .to_owned(),
    )
}

/// A document, and for its variables and its calls the line they begin at and the lines of each among them.
struct Rendered {
    text: String,
    variables: (usize, Vec<Range<usize>>),
    calls: (usize, Vec<Range<usize>>),
}

impl Rendered {
    /// Makes the entry that a finding is about a comment; whether there is one that is none yet.
    fn mark(&self, finding: &Diagnostic, plan: &mut Plan) -> bool {
        let line = finding.at.line.saturating_sub(1);
        let within = |(start, entries): &(usize, Vec<Range<usize>>)| {
            let at = line.checked_sub(*start)?;
            entries.iter().position(|lines| lines.contains(&at))
        };
        let variable = within(&self.variables).and_then(|at| plan.entries.get_mut(at));
        let variable = variable.map(|entry| (&mut entry.faulty, entry.origin));
        let call = within(&self.calls).and_then(|at| plan.calls.get_mut(at));
        let call = call.map(|entry| (&mut entry.faulty, entry.origin));
        match variable.or(call) {
            Some((faulty @ None, origin)) => {
                *faulty = Some(why(finding, origin));
                true
            }
            Some((Some(_), _)) | None => false,
        }
    }
}

/// What a comment says of an entry that has a finding.
fn why(finding: &Diagnostic, origin: SpaceId) -> String {
    let why = format!("{}: {}", finding.code, finding.message);
    let hint = if finding.code == Code::UnknownMessageType && origin == SpaceId::ROS1 {
        "Publishers of ROS 1 bring it along: without the `#` it crosses, and check warns of it"
    } else if finding.code == Code::UnknownMessageType {
        "Where the bridge finds its package by AMENT_PREFIX_PATH it crosses without the `#`"
    } else if finding.code == Code::MethodTarget {
        "With another `endpoint` under `server`, for the cell's own server, it is called without the `#`"
    } else if [Code::UnknownServiceType, Code::UnknownActionType].contains(&finding.code) {
        "Where the bridge finds its package, by ROS_PACKAGE_PATH or AMENT_PREFIX_PATH, it crosses without the `#`"
    } else {
        return why;
    };
    format!("{why}\n{hint}")
}

/// Renders until no entry has a finding: those that have one become comments with its text.
fn settled(
    file: &str,
    plan: &mut Plan,
    render: impl Fn(&Plan) -> Option<Rendered>,
) -> Result<String, Failure> {
    loop {
        let rendered = render(plan).ok_or_else(unmergeable)?;
        let Checked {
            mapping, findings, ..
        } = Mapping::from_text(&rendered.text, file, &Disk);
        let here = findings.iter().filter(|finding| *finding.at.file == *file);
        let marked = here.filter(|finding| rendered.mark(finding, plan)).count();
        if marked > 0 {
            continue;
        }
        // Such as that there is too much of it.
        return match (mapping, findings.first()) {
            (None, Some(first)) => Err(Failure::Unconfigured(format!(
                "what would be written could not run: {}",
                first.message
            ))),
            (Some(_), _) | (None, None) => Ok(rendered.text),
        };
    }
}

fn put(arguments: &Init, before: Option<&str>, text: &str, plan: &Plan) -> Result<(), Failure> {
    let Some(file) = &arguments.output else {
        let mut out = io::stdout().lock();
        out.write_all(text.as_bytes())?;
        out.flush()?;
        report::warn(&Sum::of("the mapping", plan, true).to_string());
        return Ok(());
    };
    let sum = Sum::of(file, plan, before != Some(text));
    match before {
        Some(before) if before == text => {}
        Some(before) if arguments.merge => replace(file, before, text)?,
        Some(_) => {
            return Err(Failure::Io(format!(
                "{file} is there and stays as it is: {} would be new in it. Say --merge to add them, or choose another \
                 file",
                sum.counts()
            )));
        }
        None => {
            let opened = OpenOptions::new().write(true).create_new(true).open(file);
            opened
                .and_then(|mut opened| opened.write_all(text.as_bytes()))
                .map_err(|error| cannot_write(file, &error))?;
        }
    }
    let mut out = io::stdout().lock();
    if arguments.json {
        let line = serde_json::to_string(&sum).map_err(|error| Failure::Data(error.to_string()))?;
        writeln!(out, "{line}")?;
    } else {
        writeln!(out, "{sum}")?;
    }
    Ok(out.flush()?)
}

/// Puts another text in the place of that which was read, at once and with its permissions. The survey takes some time, in
/// which somebody may have saved the file.
fn replace(file: &str, before: &str, text: &str) -> Result<(), Failure> {
    let now = bytes_of(file).map_err(|error| Failure::reading(file, &error))?;
    if now != before.as_bytes() {
        return Err(Failure::Io(format!(
            "{file} was changed while this looked around; it stays as it is now: say the same again"
        )));
    }
    exchanged(file, text).map_err(|error| cannot_write(file, &error))
}

/// Writes beside the file and renames: who reads it meanwhile has the one text or the other.
fn exchanged(file: &str, text: &str) -> io::Result<()> {
    // What a link names is exchanged, not the link.
    let target = std::fs::canonicalize(file)?;
    let found = target.metadata()?;
    if !found.is_file() {
        return Err(io::Error::other("it is no regular file"));
    }
    // Who may write into the folder may not yet write the file.
    drop(OpenOptions::new().write(true).open(&target)?);
    let beside = beside(&target);
    let mut opened = OpenOptions::new()
        .write(true)
        .create_new(true)
        .open(&beside)?;
    // Root leaves the file to whom it belongs; who is not root can give nothing away.
    drop(fchown(&opened, Some(found.uid()), Some(found.gid())));
    let written = opened
        .set_permissions(found.permissions())
        .and_then(|()| opened.write_all(text.as_bytes()))
        .and_then(|()| opened.sync_all())
        .and_then(|()| std::fs::rename(&beside, &target));
    if written.is_err() {
        // The cause counts.
        drop(std::fs::remove_file(&beside));
    }
    written
}

/// A name in the same folder, hidden, so that no `include` takes it.
fn beside(target: &Path) -> PathBuf {
    let mut name = std::ffi::OsString::from(".");
    name.push(target.file_name().unwrap_or_default());
    name.push(format!(".{}", std::process::id()));
    target.with_file_name(name)
}

fn cannot_write(file: &str, error: &io::Error) -> Failure {
    Failure::Io(format!("cannot write {file}: {error}"))
}

/// What came of it.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Sum<'a> {
    file: &'a str,
    changed: bool,
    variables: usize,
    guesses: usize,
    calls: usize,
    commented_out: usize,
    left_out: usize,
}

impl<'a> Sum<'a> {
    fn of(file: &'a str, plan: &Plan, changed: bool) -> Self {
        let active = || plan.entries.iter().filter(|entry| entry.faulty.is_none());
        let calls = plan.calls.iter().filter(|call| call.faulty.is_none());
        let calls = calls.count();
        Self {
            file,
            changed,
            variables: active().count(),
            guesses: active().filter(|entry| entry.guessed).count(),
            calls,
            commented_out: plan.entries.len() - active().count() + plan.calls.len() - calls,
            left_out: plan
                .left_out
                .values()
                .map(std::collections::BTreeSet::len)
                .sum(),
        }
    }

    fn counts(&self) -> String {
        let several = |count: usize, one: &str| match count {
            1 => format!("1 {one}"),
            _ => format!("{count} {one}s"),
        };
        format!(
            "{} ({}), {}, {} as comments, {} left out",
            several(self.variables, "variable"),
            several(self.guesses, "guess").replace("guesss", "guesses"),
            several(self.calls, "call"),
            several(self.commented_out, "other"),
            several(self.left_out, "topic"),
        )
    }
}

impl std::fmt::Display for Sum<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.changed {
            write!(f, "{}: {}", self.file, self.counts())
        } else {
            write!(f, "{}: nothing is new", self.file)
        }
    }
}

/// Spaces of domains 0 and 1 begin here: lower numbers are those of the domains people have.
const FIRST_FREE: u16 = 40;
/// More than a mapping may have (M002).
const MOST: u64 = 5 << 20;

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet};

    use mappings::{LiveSpace, LiveTopic};

    use super::*;

    const WISHES: Wishes<'static> = Wishes {
        namespace: "urn:cell",
        transforms: false,
    };

    /// A graph whose topics are (name, type, published).
    fn graph(space: u16, topics: &[(&str, &str, bool)]) -> Graph {
        let topic = |(name, kind, published): &(&str, &str, bool)| {
            let live = LiveTopic {
                types: BTreeSet::from([(*kind).to_owned()]),
                published: *published,
                subscribed: !published,
            };
            ((*name).to_owned(), live)
        };
        Graph {
            space: SpaceId::new(space).unwrap(),
            domain: (space > 1).then_some(space),
            live: LiveSpace {
                topics: topics.iter().map(topic).collect::<BTreeMap<_, _>>(),
                services: None,
            },
        }
    }

    fn fresh(graphs: &[Graph]) -> String {
        let mut plan = Plan::new(graphs, &[], &WISHES, &mut Known::default());
        written("", &[], &mut plan).unwrap()
    }

    fn merged(text: &str, graphs: &[Graph]) -> String {
        let mapping = mapping(text);
        let mut known = Known::of(mapping.clone(), text);
        let mut plan = Plan::new(graphs, &[], &WISHES, &mut known);
        added("", (text, &mapping), &mut plan).unwrap()
    }

    fn mapping(text: &str) -> Mapping {
        let checked = Mapping::from_yaml(text, "cell.yaml");
        assert!(checked.findings.is_empty(), "{}", checked.render(text));
        checked.mapping.unwrap()
    }

    fn origins(text: &str) -> Vec<(String, String, usize)> {
        let mapping = mapping(text);
        let variables = mapping.variables().iter();
        variables
            .map(|one| (one.name.clone(), one.topic.to_string(), one.bindings.len()))
            .collect()
    }

    #[test]
    fn a_side_that_joins_later_is_proposed_once_and_changes_nothing() {
        let ros1 = graph(1, &[("/a/b", "std_msgs/Bool", true)]);
        let ros2 = graph(
            2,
            &[
                ("/a/b", "std_msgs/Bool", false),
                ("/c", "std_msgs/Int32", true),
            ],
        );
        let first = fresh(std::slice::from_ref(&ros1));
        let both = [ros1, ros2];
        let second = merged(&first, &both);
        assert!(
            second
                .contains("#   /a/b is in space 2 too, as std_msgs/Bool: AB could be bound to it"),
            "{second}"
        );
        assert_eq!(
            origins(&second),
            [
                ("AB".to_owned(), "ua_1_2_1".to_owned(), 1),
                ("C".to_owned(), "ua_2_2_2".to_owned(), 1)
            ]
        );
        assert_eq!(merged(&second, &both), second);
        // Seen together, they are one value.
        assert_eq!(
            origins(&fresh(&both))[0],
            ("AB".to_owned(), "ua_1_2_1".to_owned(), 2)
        );
    }

    #[test]
    fn a_block_is_indented_as_the_entries_before_it() {
        let text = "spaces:\n- {id: 1}\nnamespaces:\n    2: urn:line\nvariables:\n- {node: ns=2;i=5, name: v, origin: 1, \
                    type: Double}\n";
        let more = merged(text, &[graph(2, &[("/a", "std_msgs/Bool", true)])]);
        assert!(more.contains("\n- {id: 2, domain: 2}\n"), "{more}");
        assert!(more.contains("\n    3: urn:cell\n"), "{more}");
        assert_eq!(origins(&more).len(), 2);
    }

    #[test]
    fn a_file_that_was_saved_meanwhile_stays_as_it_is() {
        let file = std::env::temp_dir().join(format!("ua-space-init-{}.yaml", std::process::id()));
        let name = file.to_str().unwrap();
        std::fs::write(&file, "theirs\n").unwrap();
        let refused = replace(name, "before\n", "mine\n").unwrap_err();
        assert!(refused.to_string().contains("was changed"), "{refused}");
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "theirs\n");
        replace(name, "theirs\n", "mine\n").unwrap();
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "mine\n");
        assert!(!beside(&file.canonicalize().unwrap()).exists());
        std::fs::remove_file(&file).unwrap();
    }

    #[test]
    fn what_both_sides_publish_is_two_values_and_what_differs_in_type_too() {
        let text = fresh(&[
            graph(
                1,
                &[("/x", "std_msgs/Bool", true), ("/y", "std_msgs/Bool", true)],
            ),
            graph(
                2,
                &[
                    ("/x", "std_msgs/Bool", true),
                    ("/y", "std_msgs/Int32", false),
                ],
            ),
        ]);
        let all = origins(&text);
        let topics: Vec<&str> = all.iter().map(|(_, topic, _)| topic.as_str()).collect();
        assert_eq!(topics, ["ua_1_2_1", "ua_2_2_2", "ua_1_2_3", "ua_0_2_4"]);
        assert!(all.iter().all(|(.., bindings)| *bindings == 1) && !text.contains("guess:"));
    }

    #[test]
    fn a_topic_that_a_comment_names_or_a_pattern_takes_stays_out() {
        let text = "spaces:\n  - {id: 1}\nnamespaces:\n  2: urn:line\nvariables:\n  # not /a\n  - {node: ns=2;i=5, name: v, \
                    origin: 1, ros: {topic: /v, type: std_msgs/Bool}}\npatterns:\n  - {topics: \"/r*/p\", origin: 1, node: \
                    \"ns=2;i=10{1}\", name: \"P{1}\"}\n";
        let seen = graph(
            1,
            &[
                ("/a", "std_msgs/Bool", true),
                ("/r1/p", "std_msgs/Bool", true),
                ("/v", "std_msgs/Bool", true),
            ],
        );
        assert_eq!(merged(text, &[seen]), text);
        let more = merged(text, &[graph(1, &[("/next", "std_msgs/Bool", true)])]);
        // In the namespace of the others, behind the highest number, and before the next key.
        assert_eq!(origins(&more)[1].1, "ua_1_2_6");
        assert!(more.find("name: Next").unwrap() < more.find("patterns:").unwrap());
    }

    #[test]
    fn what_calls_have_is_not_given_away_and_their_services_are_not_told_of() {
        let text = "spaces:\n  - {id: 1}\n  - {id: 2}\nnamespaces:\n  2: urn:cell\ncalls:\n  - {node: ns=2;i=61, name: A, origin: \
                    1, ros: [{service: /a, type: std_srvs/SetBool}, {space: 2, service: /b, type: std_srvs/SetBool}]}\n";
        let mut seen = graph(2, &[("/a", "std_msgs/Bool", true)]);
        let service = |name: &str| {
            let kind = BTreeSet::from(["std_srvs/SetBool".to_owned()]);
            (name.to_owned(), kind)
        };
        seen.live.services = Some(
            ["/b", "/c", "/n/get_parameters", "/ua_1_2_61"]
                .map(service)
                .into(),
        );
        let more = merged(text, std::slice::from_ref(&seen));
        // Behind the number of the call, under another name than its own.
        assert_eq!(
            origins(&more),
            [("A2".to_owned(), "ua_2_2_62".to_owned(), 1)]
        );
        let calls = mapping(&more).calls().to_vec();
        let calls: Vec<(String, String)> = calls
            .iter()
            .map(|call| (call.topic.to_string(), call.name.clone()))
            .collect();
        let one = |topic: &str, name: &str| (topic.to_owned(), name.to_owned());
        assert_eq!(calls, [one("ua_1_2_61", "A"), one("ua_2_2_63", "C")]);
        assert_eq!(merged(&more, &[seen]), more);
    }

    #[test]
    fn what_is_executed_anywhere_becomes_calls_once() {
        let mut ros1 = graph(
            1,
            &[(
                "/count/feedback",
                "actionlib_tutorials/FibonacciActionFeedback",
                true,
            )],
        );
        let kinds = |kinds: &[&str]| kinds.iter().map(|kind| (*kind).to_owned()).collect();
        ros1.live.services = Some(
            [
                ("/belt/switch", kinds(&["std_srvs/SetBool"])),
                ("/belt/odd", kinds(&["odd_msgs/Odd"])),
                ("/belt/mute", kinds(&[])),
                (
                    "/belt/set_parameters",
                    kinds(&["dynamic_reconfigure/Reconfigure"]),
                ),
                ("/ua_1_2_9", kinds(&["std_srvs/SetBool"])),
            ]
            .map(|(name, kinds)| (name.to_owned(), kinds))
            .into(),
        );
        let feedback = "/nav/count/_action/feedback";
        let kind = "example_interfaces/Fibonacci_FeedbackMessage";
        let ros2 = graph(2, &[(feedback, kind, true)]);
        let server = |url: &str| Nodes {
            place: url.to_owned(),
            server: Some(survey::UaServer {
                endpoint: url.to_owned(),
                name: "Press 7 (left)".to_owned(),
                is_cell: false,
            }),
            namespaces: ["http://opcfoundation.org/UA/", "urn:s", "urn:plc"]
                .map(str::to_owned)
                .to_vec(),
            variables: Vec::new(),
            methods: vec![survey::UaMethod {
                object: "ns=2;s=Line".parse().unwrap(),
                method: format!("ns=2;s=Reset of {url}").parse().unwrap(),
                name: "Reset".to_owned(),
                within: "Line".to_owned(),
            }],
        };
        let graphs = [ros1, ros2];
        let servers = ["opc.tcp://127.0.0.1:4840", "opc.tcp://plc:4840"].map(server);
        let mut plan = Plan::new(&graphs, &servers, &WISHES, &mut Known::default());
        let text = written("", &[], &mut plan).unwrap();
        let found = mapping(&text);
        let calls: Vec<(String, &str)> = found
            .calls()
            .iter()
            .map(|call| (call.topic.to_string(), call.name.as_str()))
            .collect();
        let one = |topic: &str, name: &'static str| (topic.to_owned(), name);
        // An action takes five numbers, a comment the one it says.
        assert_eq!(
            calls,
            [
                one("ua_1_2_2", "Belt.Switch"),
                one("ua_1_2_3", "Count"),
                one("ua_2_2_8", "Nav.Count"),
                one("ua_0_2_14", "Line.Reset2"),
            ],
            "{text}"
        );
        for told in [
            "  # M075: no definition of the service type `odd_msgs/Odd` is built in",
            "  #   ros: {service: /belt/odd, type: odd_msgs/Odd}",
            "  # M136: the endpoint is that of the cell's own server",
            "  #   /belt/mute",
            "    opcua: {endpoint: opc.tcp://plc:4840, object: nsu=urn:plc;s=Line, ",
        ] {
            assert!(text.contains(told), "{told}\n{text}");
        }
        let sum = Sum::of("x", &plan, true).counts();
        assert!(sum.contains("4 calls, 2 others as comments"), "{sum}");
        let mut known = Known::of(found.clone(), &text);
        let mut plan = Plan::new(&graphs, &servers, &WISHES, &mut known);
        assert_eq!(added("", (&text, &found), &mut plan).unwrap(), text);
    }

    #[test]
    fn calls_that_stand_before_the_variables_keep_both_apart() {
        let text = "spaces:\n  - {id: 1}\nnamespaces:\n  2: urn:cell\ncalls:\n  - {node: ns=2;i=61, name: A, origin: 1, ros: \
                    {service: /a, type: std_srvs/SetBool}}\nvariables:\n  - {node: ns=2;i=5, name: v, origin: 1, type: Double}\n";
        let mut seen = graph(
            1,
            &[
                ("/odd", "odd_msgs/Odd", true),
                ("/b", "std_msgs/Bool", true),
            ],
        );
        let service = |name: &str, kind: &str| (name.to_owned(), BTreeSet::from([kind.to_owned()]));
        seen.live.services = Some(
            [
                service("/c", "odd_msgs/Odd"),
                service("/d", "std_srvs/Trigger"),
            ]
            .into(),
        );
        let more = merged(text, &[seen]);
        let found = mapping(&more);
        assert_eq!(
            (found.calls().len(), found.variables().len()),
            (2, 2),
            "{more}"
        );
        assert!(
            more.contains("\n  # M075: ") && more.contains("\n  # M063: "),
            "{more}"
        );
    }
}

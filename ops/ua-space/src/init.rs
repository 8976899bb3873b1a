//! `ua-space init`: proposes a mapping from live graphs, servers, NodeSets and SysML models.

mod calls;
mod known;
mod merge;
mod nodes;
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

use mappings::{Checked, Code, Diagnostic, LiveSpace, Mapping, SpaceId};
use serde::Serialize;
use type_files::Disk;

use crate::arguments::Init;
use crate::discover::{self, DiscoveredKind};
use crate::exit::CommandFailure;
use crate::report;
use crate::survey::model::NodeModel;
use crate::survey::{self, SurveyedGraph, SurveyedNodes, look};
use known::OldMapping;
use plan::{Proposal, Wishes};

pub(crate) fn init(arguments: &Init) -> Result<(), CommandFailure> {
    let asked = [
        arguments.ros1.is_none(),
        arguments.ros2.is_empty(),
        arguments.nodeset.is_empty(),
        arguments.opcua.is_empty(),
        arguments.model.is_empty(),
        !arguments.discover,
    ];
    if asked.iter().all(|nothing| *nothing) {
        return Err(CommandFailure::Usage(
            "nothing to look at: give one or several of --ros1, --ros2, --nodeset FILE, --model FILE, \
             --opcua URL, --discover"
                .to_owned(),
        ));
    }
    let existing = match &arguments.output {
        Some(file) => existing(file)?,
        None => None,
    };
    let mut known = match &existing {
        Some((mapping, text)) => OldMapping::of(mapping.clone(), text),
        None => OldMapping::default(),
    };
    let found = InspectedSources::look(arguments, &known.mapping)?;
    let wishes = Wishes {
        namespace: &arguments.namespace,
        transforms: arguments.tf,
    };
    let mut plan = Proposal::new(
        &found.models,
        &found.graphs,
        &found.nodes,
        &wishes,
        &mut known,
    );
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

/// The inspected sources.
struct InspectedSources {
    models: Vec<NodeModel>,
    graphs: Vec<SurveyedGraph>,
    nodes: Vec<SurveyedNodes>,
    /// The names of the sources for the head of the file, in order.
    places: Vec<String>,
}

impl InspectedSources {
    fn look(arguments: &Init, known: &Mapping) -> Result<Self, CommandFailure> {
        let mut found = Self {
            models: Vec::new(),
            graphs: Vec::new(),
            nodes: Vec::new(),
            places: Vec::new(),
        };
        for file in &arguments.model {
            let model = survey::model::survey(file)?;
            found.places.push(model.place.clone());
            found.models.push(model);
        }
        if let Some(uri) = &arguments.ros1 {
            let uri = uri.clone().unwrap_or_else(survey::ros1::master_uri);
            let live = look(survey::ros1::survey(&uri))?;
            found.places.push(format!("ROS 1 master {uri}"));
            found.graphs.push(SurveyedGraph {
                space: SpaceId::ROS1,
                domain: None,
                live,
            });
        }
        for domain in domains(&arguments.ros2)? {
            let space = space_of(domain, known, &found.graphs)?;
            let wait = Duration::from_secs(arguments.wait.into());
            let live = look(survey::ros2::survey(domain, wait))?;
            found.domain(domain, space, live);
        }
        for url in &arguments.opcua {
            found.add(look(survey::opcua::survey(url))?);
        }
        for file in &arguments.nodeset {
            found.add(survey::nodeset::survey(file)?);
        }
        if arguments.discover {
            found.discover(arguments, known)?;
        }
        Ok(found)
    }

    /// Adds the discovered sources that were not named in the arguments. Sources that cannot be
    /// inspected are named in the head of the file.
    fn discover(&mut self, arguments: &Init, known: &Mapping) -> Result<(), CommandFailure> {
        if arguments.ros1.is_none() {
            let uri = survey::ros1::master_uri();
            if let Ok(live) = look(survey::ros1::survey(&uri)) {
                self.places.push(format!("ROS 1 master {uri}"));
                self.graphs.push(SurveyedGraph {
                    space: SpaceId::ROS1,
                    domain: None,
                    live,
                });
            }
        }
        if arguments.ros2.is_empty() {
            for domain in domains(&[None])? {
                let space = space_of(domain, known, &self.graphs)?;
                let wait = Duration::from_secs(arguments.wait.into());
                let live = look(survey::ros2::survey(domain, wait));
                if let Some(live) = live.ok().filter(|live| !live.topics.is_empty()) {
                    self.domain(domain, space, live);
                }
            }
        }
        for entry in look(discover::around(&arguments.look))?.entries {
            // Components and bridges take part in the space without a mapping.
            let is_source = matches!(entry.kind, DiscoveredKind::Server | DiscoveredKind::Cell);
            let Some(url) = entry.urls.first().filter(|_| is_source) else {
                continue;
            };
            if arguments.opcua.contains(url) {
                continue;
            }
            let found = match &entry.fault {
                Some(fault) => Err(fault.clone()),
                None => look(survey::opcua::survey(url)).map_err(|failure| failure.to_string()),
            };
            match found {
                Ok(nodes) => self.add(nodes),
                Err(why) => {
                    let why = why.lines().next().unwrap_or_default().to_owned();
                    self.places.push(format!("not OPC UA server {url}: {why}"));
                }
            }
        }
        Ok(())
    }

    fn domain(&mut self, domain: u16, space: SpaceId, live: LiveSpace) {
        self.places.push(format!("DDS domain {domain}"));
        self.graphs.push(SurveyedGraph {
            space,
            domain: Some(domain),
            live,
        });
    }

    fn add(&mut self, nodes: SurveyedNodes) {
        self.places.push(nodes.place.clone());
        self.nodes.push(nodes);
    }
}

/// Returns the requested domains in ascending order, without duplicates.
fn domains(asked: &[Option<u16>]) -> Result<Vec<u16>, CommandFailure> {
    let mut domains = Vec::new();
    for asked in asked {
        let variable = std::env::var("ROS_DOMAIN_ID").ok();
        let domain = match (asked, variable.as_deref().map(str::trim)) {
            (Some(domain), _) => *domain,
            (None, None | Some("")) => 0,
            (None, Some(text)) => text
                .parse()
                .ok()
                .filter(|domain| *domain <= 232)
                .ok_or_else(|| {
                    CommandFailure::Usage(format!("ROS_DOMAIN_ID is `{text}`: it is 0 to 232"))
                })?,
        };
        if !domains.contains(&domain) {
            domains.push(domain);
        }
    }
    domains.sort_unstable();
    Ok(domains)
}

/// Returns the space of a domain: its space in the mapping, the space with its number, or a free
/// space for domains 0 and 1.
fn space_of(
    domain: u16,
    known: &Mapping,
    graphs: &[SurveyedGraph],
) -> Result<SpaceId, CommandFailure> {
    let taken = |space: &SpaceId| graphs.iter().any(|graph| graph.space == *space);
    if let Some(space) = known.space_of_domain(domain).filter(|space| !taken(space)) {
        return Ok(space);
    }
    let free = |space: &SpaceId| known.space(*space).is_none() && !taken(space);
    let mut spaces = (FIRST_FREE..=232)
        .chain(2..FIRST_FREE)
        .filter_map(SpaceId::new);
    spaces.find(free).ok_or_else(|| {
        CommandFailure::Unconfigured("no ROS 2 space is left for another domain".to_owned())
    })
}

/// Reads the mapping in the file; `None` if the file does not exist.
fn existing(file: &str) -> Result<Option<(Mapping, String)>, CommandFailure> {
    let bytes = match bytes_of(file) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(CommandFailure::reading(file, &error)),
    };
    let text = String::from_utf8(bytes).map_err(|_| {
        CommandFailure::Io(format!("{file} is there and is no text; it stays as it is"))
    })?;
    let mut checked = Mapping::from_text(&text, file, &Disk);
    match checked.mapping.take() {
        Some(mapping) => Ok(Some((mapping, text))),
        None => Err(CommandFailure::Unconfigured(format!(
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

/// Returns a new document.
fn written(file: &str, places: &[String], plan: &mut Proposal) -> Result<String, CommandFailure> {
    settled(file, plan, |plan| {
        let mut lines = render::head(places);
        let spaces = "The ROS sides. 1 is ROS 1, others are DDS domains; 0, the OPC UA side, is always there.";
        section(&mut lines, spaces, "spaces", render::spaces(plan, "  "));
        lines.extend(render::network(plan));
        let namespaces = "The namespaces of the node ids. check --environment compares each URI with that of the server.";
        section(
            &mut lines,
            namespaces,
            "namespaces",
            render::namespaces(plan, "  "),
        );
        let servers = "Servers that exist already: ua-server is their client, and a value is bad while its server is away. Their best security\n\
             # is taken that both sides know; say `security`, `user` and `password` where that is not enough.";
        section(&mut lines, servers, "servers", render::servers(plan, "  "));
        let variables = render::variables(plan, "  ");
        if !variables.lines.is_empty() {
            lines.extend(
                [
                    "",
                    "# `origin` is the space that produces the value: there its topic is read, on the other sides it is written.",
                ]
                .map(str::to_owned),
            );
            // A list that holds only comments would be null.
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

/// The heading of the calls of a new document.
const CALLS: [&str; 5] = [
    "",
    "# What one space executes and the others ask for: there each has its name in the space, as /ua_1_2_61, or the one that a",
    "# binding of that space says, as `ros: [{service: /NAME, type: std_srvs/SetBool}, {space: 2, service: /OTHER, type: std_srvs/SetBool}]`.",
    "# An action takes five numbers. Requests of other hosts are executed with `open: true`.",
    "calls:",
];

fn section(lines: &mut Vec<String>, title: &str, key: &str, block: Vec<String>) {
    if !block.is_empty() {
        lines.push(String::new());
        // Positions are counted in lines.
        lines.extend(format!("# {title}").lines().map(str::to_owned));
        lines.push(format!("{key}:"));
        lines.extend(block);
    }
}

/// Returns the document with the new entries added.
fn added(
    file: &str,
    (text, before): (&str, &Mapping),
    plan: &mut Proposal,
) -> Result<String, CommandFailure> {
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

fn unmergeable() -> CommandFailure {
    CommandFailure::Unconfigured(
        "nothing can be put into the file as it is written: have each of `spaces`, `namespaces`, `servers`, `variables` and `calls` \
         on lines of their own below the key, not in brackets or braces; it stays as it is"
            .to_owned(),
    )
}

/// A document, with the line at which its variables and its calls begin and the line ranges of the
/// entries.
struct Rendered {
    text: String,
    variables: (usize, Vec<Range<usize>>),
    calls: (usize, Vec<Range<usize>>),
}

impl Rendered {
    /// Comments out the entry with the finding. Returns true if an active entry was found.
    fn mark(&self, finding: &Diagnostic, plan: &mut Proposal) -> bool {
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

/// Returns the comment of an entry with a finding.
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

/// Renders until no entry has a finding. Entries with a finding become comments with its text.
fn settled(
    file: &str,
    plan: &mut Proposal,
    render: impl Fn(&Proposal) -> Option<Rendered>,
) -> Result<String, CommandFailure> {
    loop {
        let rendered = render(plan).ok_or_else(unmergeable)?;
        let Checked {
            mapping, findings, ..
        } = Mapping::from_text(&rendered.text, file, &Disk);
        // An entry without `on_loss` runs, and has a comment that explains `on_loss`.
        let here = findings
            .iter()
            .filter(|finding| *finding.at.file == *file && finding.code != Code::EndlessMotion);
        let marked = here.filter(|finding| rendered.mark(finding, plan)).count();
        if marked > 0 {
            // The file already contains the comment.
            plan.entries
                .retain(|entry| entry.faulty.is_none() || !entry.is_set_aside);
            plan.calls
                .retain(|call| call.faulty.is_none() || !call.is_set_aside);
            continue;
        }
        // For example, the document is too large.
        return match (mapping, findings.first()) {
            (None, Some(first)) => Err(CommandFailure::Unconfigured(format!(
                "what would be written could not run: {}",
                first.message
            ))),
            (Some(_), _) | (None, None) => Ok(rendered.text),
        };
    }
}

fn put(
    arguments: &Init,
    before: Option<&str>,
    text: &str,
    plan: &Proposal,
) -> Result<(), CommandFailure> {
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
            return Err(CommandFailure::Io(format!(
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
        writeln!(out, "{}", crate::live::json(&sum)?)?;
    } else {
        writeln!(out, "{sum}")?;
    }
    Ok(out.flush()?)
}

/// Replaces the text of the file atomically and keeps its permissions. Fails if the file was
/// changed during the survey.
fn replace(file: &str, before: &str, text: &str) -> Result<(), CommandFailure> {
    let now = bytes_of(file).map_err(|error| CommandFailure::reading(file, &error))?;
    if now != before.as_bytes() {
        return Err(CommandFailure::Io(format!(
            "{file} was changed while this looked around; it stays as it is now: say the same again"
        )));
    }
    exchanged(file, text).map_err(|error| cannot_write(file, &error))
}

/// Writes a temporary file in the same folder and renames it, so readers see either the old or the
/// new text.
fn exchanged(file: &str, text: &str) -> io::Result<()> {
    // A symbolic link stays; its target is replaced.
    let target = std::fs::canonicalize(file)?;
    let found = target.metadata()?;
    if !found.is_file() {
        return Err(io::Error::other("it is no regular file"));
    }
    // Write permission for the folder does not imply write permission for the file.
    drop(OpenOptions::new().write(true).open(&target)?);
    let beside = beside(&target);
    let mut opened = OpenOptions::new()
        .write(true)
        .create_new(true)
        .open(&beside)?;
    // Root keeps the owner of the file. For other users, changing the owner may fail.
    drop(fchown(&opened, Some(found.uid()), Some(found.gid())));
    let written = opened
        .set_permissions(found.permissions())
        .and_then(|()| opened.write_all(text.as_bytes()))
        .and_then(|()| opened.sync_all())
        .and_then(|()| std::fs::rename(&beside, &target));
    if written.is_err() {
        // The first error is reported, not an error of the removal.
        drop(std::fs::remove_file(&beside));
    }
    written
}

/// Returns a hidden name in the same folder, which no `include` pattern matches.
fn beside(target: &Path) -> PathBuf {
    let mut name = std::ffi::OsString::from(".");
    name.push(target.file_name().unwrap_or_default());
    name.push(format!(".{}", std::process::id()));
    target.with_file_name(name)
}

fn cannot_write(file: &str, error: &io::Error) -> CommandFailure {
    CommandFailure::Io(format!("cannot write {file}: {error}"))
}

/// The summary of the written mapping.
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
    fn of(file: &'a str, plan: &Proposal, changed: bool) -> Self {
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

/// The first space for domains 0 and 1; lower numbers are kept for domains with the same number.
const FIRST_FREE: u16 = 40;
/// One byte more than the largest mapping (M002).
const MOST: u64 = (32 << 20) + 1;

#[cfg(test)]
mod tests;

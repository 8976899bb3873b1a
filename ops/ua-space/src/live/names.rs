//! Names of topics and calls, as users type them: the name in the mapping or of a component, or the
//! ROS topic.

use std::collections::BTreeMap;
use std::time::Duration;

use mappings::{Mapping, TopicId, Variable};

use super::book::{Book, DatagramContent, NameKind};
use super::described::AnnouncedDescription;
use super::prober::FIRST_ASKED;
use super::text::harmless;
use super::{Go, ListenEnd, Live};
use crate::arguments::NamedTarget;
use crate::exit::CommandFailure;
use crate::report::warn;

/// How well a name fits; the best fit wins.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Fit {
    /// The whole name, or the whole ROS topic.
    Whole,
    /// The last parts of a name, or the ROS topic without its leading `/`.
    End,
    /// As `End`, in another case.
    AnyCase,
}

/// A topic or call that may be meant.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Candidate {
    topic: TopicId,
    /// The name, and the ROS topics.
    label: String,
}

/// Returns the topics and calls of a kind that fit the name best, in the order of topics. `None`
/// stands for all kinds. The name of a skill is its Start.
fn find(book: &Book, name: &str, kind: Option<NameKind>) -> Vec<Candidate> {
    let found = find_named(book, name, kind);
    match kind {
        Some(NameKind::Call) if found.is_empty() => {
            find_named(book, &format!("{name}.Start"), kind)
        }
        _ => found,
    }
}

fn find_named(book: &Book, name: &str, kind: Option<NameKind>) -> Vec<Candidate> {
    let announced = book.announced();
    let of_kind = announced.filter(|(_, of, ..)| kind.is_none_or(|kind| kind == *of));
    let mut best: Option<Fit> = None;
    let mut found: BTreeMap<TopicId, String> = BTreeMap::new();
    for (topic, _, described, _) in of_kind {
        let Some(fit) = fit(described, name) else {
            continue;
        };
        if best.is_none_or(|best| fit < best) {
            best = Some(fit);
            found.clear();
        }
        if best == Some(fit) {
            found.entry(topic).or_insert_with(|| label(described));
        }
    }
    let found = found.into_iter();
    found
        .map(|(topic, label)| Candidate { topic, label })
        .collect()
}

fn fit(described: &AnnouncedDescription, name: &str) -> Option<Fit> {
    best_fit(described.names(), name)
}

/// Returns how well the best of several names fits.
fn best_fit<'n>(names: impl Iterator<Item = &'n str>, name: &str) -> Option<Fit> {
    let fits = names.map(|known| {
        let ends = |known: &str, name: &str| {
            let before = known.strip_suffix(name);
            before.is_some_and(|before| before.ends_with('.') || before == "/")
        };
        if known == name {
            Some(Fit::Whole)
        } else if ends(known, name) {
            Some(Fit::End)
        } else {
            let (known, name) = (known.to_lowercase(), name.to_lowercase());
            (known == name || ends(&known, &name)).then_some(Fit::AnyCase)
        }
    });
    fits.flatten().min()
}

/// Returns true if a user may mean the known name by `name`: the whole name or its last parts.
pub(super) fn is_fitting(known: &str, name: &str) -> bool {
    best_fit(std::iter::once(known), name).is_some()
}

/// Returns the topics with the names that fit best.
pub(crate) fn fitting<'t>(known: &[(&'t str, Vec<&str>)], name: &str) -> Vec<&'t str> {
    let fits = known.iter().filter_map(|(topic, names)| {
        let fit = best_fit(names.iter().copied(), name)?;
        Some((fit, *topic))
    });
    let fits: Vec<(Fit, &str)> = fits.collect();
    let best = fits.iter().map(|(fit, _)| *fit).min();
    let best = fits.into_iter().filter(|(fit, _)| Some(*fit) == best);
    best.map(|(_, topic)| topic).collect()
}

/// Returns the variables of a mapping that fit the target best.
pub(super) fn mapped<'m>(mapping: &'m Mapping, target: &NamedTarget) -> Vec<&'m Variable> {
    let name = match target {
        NamedTarget::Topic(topic) => return mapping.variable(*topic).into_iter().collect(),
        NamedTarget::Name(name) => name,
    };
    let fits = mapping.variables().iter().filter_map(|variable| {
        let ros = variable.ros_names().map(|(_, name)| name);
        let fit = best_fit(std::iter::once(variable.name.as_str()).chain(ros), name)?;
        Some((fit, variable))
    });
    let fits: Vec<(Fit, &Variable)> = fits.collect();
    let best = fits.iter().map(|(fit, _)| *fit).min();
    let best = fits.into_iter().filter(|(fit, _)| Some(*fit) == best);
    best.map(|(_, variable)| variable).collect()
}

/// Returns the name and the ROS topics of a topic for output.
fn label(described: &AnnouncedDescription) -> String {
    let names: Vec<&str> = described.names().collect();
    harmless(&names.join(", "))
}

/// Returns the error for a name with several topics.
fn ambiguous(name: &str, found: &[Candidate]) -> CommandFailure {
    let each = found.iter().take(MOST_SHOWN);
    let each = each.map(|one| format!("\n    {}  {}", one.topic, one.label));
    let each: String = each.collect();
    let rest = match found.len().saturating_sub(MOST_SHOWN) {
        0 => String::new(),
        rest => format!("\n    and {rest} more"),
    };
    let name = harmless(name);
    CommandFailure::Usage(format!(
        "{name} is the name of {} topics\n  = help: give one of these topics:{each}{rest}",
        found.len()
    ))
}

/// Returns the error for a target without a topic.
pub(super) fn unknown(live: &Live, target: &NamedTarget, seconds: f64) -> CommandFailure {
    let name = &target.to_string();
    let all: Vec<&AnnouncedDescription> = live
        .book
        .announced()
        .map(|(_, _, described, _)| described.as_ref())
        .collect();
    let names = || all.iter().flat_map(|one| one.names());
    let near = mappings::nearest(name, names().take(MOST_COMPARED));
    let help = match (near, names().count()) {
        (Some(near), _) => format!("did you mean `{}`?", harmless(near)),
        (None, 0) => {
            "no names were announced; is this the group and the interface (--address, --interface)?"
                .to_owned()
        }
        (None, _) => {
            "`ua-space list` shows the names, `ua-space status` what programs wait for".to_owned()
        }
    };
    let (name, group) = (harmless(name), live.group());
    CommandFailure::Unavailable(format!(
        "no topic named {name} was announced in {group} for {seconds} s\n  = help: {help}"
    ))
}

impl Live {
    /// Returns the first announced name of a topic.
    pub(super) fn name_of(&self, topic: TopicId) -> Option<String> {
        let described = self.book.described(topic)?;
        described.names().next().map(str::to_owned)
    }

    /// Returns the topic of a target of a kind; `None` stands for all kinds. For a name, listens
    /// until a topic with the name is announced, and passes all messages to `each` meanwhile.
    /// Returns `None` if no topic has the name at `end`.
    ///
    /// # Errors
    /// Several topics have the name, or the user interrupted the command.
    pub(super) async fn resolve(
        &mut self,
        (target, kind): (&NamedTarget, Option<NameKind>),
        end: Duration,
        each: &mut dyn FnMut(DatagramContent<'_>, Duration) -> Go,
    ) -> Result<Option<TopicId>, CommandFailure> {
        let name = match target {
            NamedTarget::Topic(topic) => {
                self.want(*topic);
                return Ok(Some(*topic));
            }
            NamedTarget::Name(name) => name,
        };
        // A bridge without values is found by a probe for applications.
        self.want_all();
        if kind != Some(NameKind::Value) {
            self.want_calls([0]);
        }
        let mut notice = Some(self.now() + NOTICE);
        let silent = self.now() + SILENT;
        let mut settled = None;
        loop {
            let next = (self.now() + STEP).min(end);
            if self.listen(next, each).await? == ListenEnd::Interrupted {
                return Err(CommandFailure::Interrupted);
            }
            let now = self.now();
            let found = find(&self.book, name, kind);
            if !found.is_empty() {
                // Others with the same name may be announced a little later.
                let settled = *settled.get_or_insert_with(|| now + settle(kind));
                match found.as_slice() {
                    _ if now < settled.min(end) => {}
                    [one] => return Ok(Some(one.topic)),
                    several => return Err(ambiguous(name, several)),
                }
            } else if now >= end {
                return Ok(None);
            } else if !self.wants_calls && now >= silent {
                // In response, programs also announce topics that have no value yet.
                self.want_calls(FIRST_ASKED);
            } else if notice.is_some_and(|at| now >= at) {
                notice = None;
                let name = harmless(name);
                warn(&format!("waiting for a topic named {name}"));
            }
        }
    }
}

/// The interval at which announced names are compared.
const STEP: Duration = Duration::from_millis(50);
/// Returns the time in which further topics with the same name may be announced. A call, such as
/// Halt, waits less.
const fn settle(kind: Option<NameKind>) -> Duration {
    match kind {
        Some(NameKind::Call) => Duration::from_millis(250),
        Some(NameKind::Value) | None => Duration::from_millis(600),
    }
}

/// The time after which a name may be that of a topic without a value.
const SILENT: Duration = Duration::from_millis(400);
/// The time after which a missing name is reported.
const NOTICE: Duration = Duration::from_secs(3);
/// Maximum number of candidates in an error message.
const MOST_SHOWN: usize = 12;
/// Maximum number of names that are compared for a suggestion.
const MOST_COMPARED: usize = 4096;

#[cfg(test)]
mod tests {
    use super::super::described::DescribedKind;
    use super::*;

    fn described(name: &str, ros: &[&str]) -> AnnouncedDescription {
        let ros = ros.iter().map(|topic| (1, (*topic).to_owned()));
        AnnouncedDescription {
            name: name.to_owned(),
            description: String::new(),
            ros_topics: ros.collect(),
            command: false,
            what: DescribedKind::Value(Vec::new()),
        }
    }

    #[test]
    fn a_name_fits_as_a_whole_at_its_end_or_as_the_ros_topic() {
        let joints = described("Robot.JointStates", &["/joint_states"]);
        for (name, fits) in [
            ("Robot.JointStates", Some(Fit::Whole)),
            ("/joint_states", Some(Fit::Whole)),
            ("JointStates", Some(Fit::End)),
            ("joint_states", Some(Fit::End)),
            ("jointstates", Some(Fit::AnyCase)),
            ("States", None),
            ("", None),
            ("Robot", None),
        ] {
            assert_eq!(fit(&joints, name), fits, "{name}");
        }
        assert_eq!(fit(&described("", &[]), ""), None);
    }

    #[test]
    fn candidates_are_listed_with_their_topics() {
        let candidate = |topic: &str, label: &str| Candidate {
            topic: topic.parse().unwrap(),
            label: label.to_owned(),
        };
        let found = [
            candidate("ua_1_2_10", "Left.Speed, /left/speed"),
            candidate("ua_1_2_11", "Right.Speed"),
        ];
        assert_eq!(
            ambiguous("Speed", &found).to_string(),
            "Speed is the name of 2 topics\n  = help: give one of these topics:\
             \n    ua_1_2_10  Left.Speed, /left/speed\n    ua_1_2_11  Right.Speed"
        );
    }
}

//! The choice among candidates for a part of the work, with a reason for each of them. Composites
//! and the MES choose by the same rules and give their reasons in the same words.

use crate::out_of_workspace::OutOfWorkspace;
use crate::partner_error::AttachedElsewhere;

/// The reason why a candidate cannot do the work.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum UnfitCandidate {
    /// The robot does not reach a position of the work.
    #[error(transparent)]
    OutOfWorkspace(#[from] OutOfWorkspace),
    /// The tool is attached to another tool changer.
    #[error(transparent)]
    AttachedElsewhere(#[from] AttachedElsewhere),
}

/// A candidate for a part of the work.
#[derive(Debug, Clone, PartialEq)]
pub struct SkillCandidate<T> {
    /// The component or skill.
    pub of: T,
    /// Its name in the reasons for the others.
    pub name: String,
    /// Whether it can do the work, or the reason why it cannot.
    pub fits: Result<(), UnfitCandidate>,
    /// Its rank among the candidates that fit.
    pub rank: CandidateRank,
}

/// The rank of a candidate: the fitting candidate of least rank is chosen. Fields are compared in
/// their order.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct CandidateRank {
    /// The attachment of the candidate.
    pub attachment: Attachment,
    /// Its place in the list of preferred components; the length of the list if it is not there.
    pub preference: usize,
    /// Number of capabilities that it realises by subclasses only.
    pub inexact: usize,
    /// The time at which it was found, ms since 1970; 0 if the time does not count.
    pub since_ms: u64,
    /// Its name, if the order of names counts; otherwise empty.
    pub name: String,
}

/// The attachment of a candidate, the best first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub enum Attachment {
    /// A robot with a tool.
    CarriesTool,
    /// A tool at a robot.
    AtRobot,
    /// Nothing that is known.
    #[default]
    None,
}

impl Attachment {
    const fn words(self) -> &'static str {
        match self {
            Self::CarriesTool => "carries a tool",
            Self::AtRobot => "is attached to a robot",
            Self::None => "is not attached",
        }
    }
}

/// A chosen candidate, and the reasons.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SkillChoice<T> {
    /// The chosen candidate.
    pub chosen: T,
    /// The reason for the choice.
    pub reason: String,
    /// The other candidates, each with the reason why it was not chosen.
    pub others: Vec<(T, String)>,
}

/// The reason why no candidate was chosen.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NoChoice<T> {
    /// No candidate can do the work; each with the reason.
    NoneFits(Vec<(T, String)>),
    /// Several candidates are equal.
    Equal(Vec<T>),
}

impl CandidateRank {
    /// Returns the place of a component in the list of preferred components.
    #[must_use]
    pub fn preference(prefer: &[String], component: &str) -> usize {
        let place = prefer.iter().position(|preferred| preferred == component);
        place.unwrap_or(prefer.len())
    }

    /// Returns the advantage of this rank over a greater rank; `None` if it is not less.
    #[must_use]
    pub fn advantage_over(&self, other: &Self) -> Option<&'static str> {
        let Self {
            attachment,
            preference,
            inexact,
            since_ms,
            name,
        } = self;
        let steps = [
            (attachment.cmp(&other.attachment), attachment.words()),
            (preference.cmp(&other.preference), "is preferred"),
            (inexact.cmp(&other.inexact), "is of just this capability"),
            (since_ms.cmp(&other.since_ms), "has been there for longer"),
            (name.cmp(&other.name), "comes first by its name"),
        ];
        let decisive = steps.into_iter().find(|(order, _)| order.is_ne());
        decisive.and_then(|(order, words)| order.is_lt().then_some(words))
    }

    /// Returns the reason why a candidate that fits is not chosen.
    #[must_use]
    pub fn why_not(&self, (chosen, better): (&str, &Self)) -> String {
        let advantage = better
            .advantage_over(self)
            .unwrap_or("was chosen for all of its roles");
        format!("it would fit, but {chosen} {advantage}")
    }
}

/// Chooses the candidate that fits and has the least rank.
///
/// # Errors
/// No candidate fits, or the least rank is that of several.
pub fn choose<T>(candidates: Vec<SkillCandidate<T>>) -> Result<SkillChoice<T>, NoChoice<T>> {
    let mut fitting = Vec::new();
    let mut others = Vec::new();
    for candidate in candidates {
        match candidate.fits {
            Ok(()) => fitting.push((candidate.rank, candidate.name, candidate.of)),
            Err(why) => others.push((candidate.of, why.to_string())),
        }
    }
    fitting.sort_by(|(one, ..), (other, ..)| one.cmp(other));
    let mut fitting = fitting.into_iter();
    let Some((rank, name, chosen)) = fitting.next() else {
        return Err(NoChoice::NoneFits(others));
    };
    let behind: Vec<_> = fitting.collect();
    let reason = match (behind.first(), others.is_empty()) {
        (None, true) => "it is the only candidate".to_owned(),
        (None, false) => "it is the only candidate that fits".to_owned(),
        (Some((next, ..)), _) => match rank.advantage_over(next) {
            Some(advantage) => format!("it {advantage}"),
            None => {
                let equal = behind.into_iter().filter(|(other, ..)| *other == rank);
                let equal = equal.map(|(_, _, of)| of);
                return Err(NoChoice::Equal(
                    std::iter::once(chosen).chain(equal).collect(),
                ));
            }
        },
    };
    let passed = behind.into_iter();
    others.extend(passed.map(|(other, _, of)| (of, other.why_not((&name, &rank)))));
    Ok(SkillChoice {
        chosen,
        reason,
        others,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate(name: &'static str, rank: CandidateRank) -> SkillCandidate<&'static str> {
        SkillCandidate {
            of: name,
            name: name.to_owned(),
            fits: Ok(()),
            rank,
        }
    }

    fn ranked(attachment: Attachment, preference: usize) -> CandidateRank {
        CandidateRank {
            attachment,
            preference,
            ..CandidateRank::default()
        }
    }

    #[test]
    fn what_is_attached_comes_before_the_rules_and_each_other_candidate_gets_a_reason() {
        let prefer = ["b".to_owned(), "a".to_owned()];
        let rank = |attachment, name| ranked(attachment, CandidateRank::preference(&prefer, name));
        let far = SkillCandidate {
            fits: Err(UnfitCandidate::OutOfWorkspace(OutOfWorkspace::Reach {
                position: [0.4, 0.0, 0.0],
                far: 0.4,
                reach: 0.3,
            })),
            ..candidate("far", CandidateRank::default())
        };
        let all = vec![
            far.clone(),
            candidate("a", rank(Attachment::CarriesTool, "a")),
            candidate("b", rank(Attachment::None, "b")),
            candidate("c", rank(Attachment::CarriesTool, "c")),
        ];
        let choice = choose(all).unwrap();
        assert_eq!((choice.chosen, &*choice.reason), ("a", "it is preferred"));
        let too_far = "0.400, 0.000, 0.000 m is 0.400 m from its base, and it reaches 0.3 m";
        let others = [
            ("far", too_far),
            ("c", "it would fit, but a is preferred"),
            ("b", "it would fit, but a carries a tool"),
        ];
        assert_eq!(choice.others, others.map(|(of, why)| (of, why.to_owned())));

        let one = vec![far.clone(), candidate("a", rank(Attachment::None, "a"))];
        assert_eq!(
            choose(one).unwrap().reason,
            "it is the only candidate that fits"
        );
        let none = vec![("far", too_far.to_owned())];
        assert_eq!(choose(vec![far]), Err(NoChoice::NoneFits(none)));
    }

    #[test]
    fn equal_candidates_are_not_chosen_by_chance() {
        let equal = ["a", "b"].map(|name| candidate(name, ranked(Attachment::AtRobot, 1)));
        let all = [candidate("c", ranked(Attachment::None, 1))]
            .into_iter()
            .chain(equal);
        assert_eq!(choose(all.collect()), Err(NoChoice::Equal(vec!["a", "b"])));
    }

    #[test]
    fn the_exact_the_older_and_the_first_are_better() {
        let rank = |inexact, since_ms, name: &str| CandidateRank {
            inexact,
            since_ms,
            name: name.to_owned(),
            ..CandidateRank::default()
        };
        let best = rank(0, 5, "b");
        for (other, advantage) in [
            (rank(1, 1, "a"), Some("is of just this capability")),
            (rank(0, 9, "a"), Some("has been there for longer")),
            (rank(0, 5, "c"), Some("comes first by its name")),
            (rank(0, 5, "a"), None),
        ] {
            assert_eq!(best.advantage_over(&other), advantage);
        }
    }
}

//! The manifests of a folder, and the components that shall run for them. No clock, no processes.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, SystemTime};

/// A manifest in the folder. It is another one when its contents may have changed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ModuleFile {
    pub(super) path: PathBuf,
    /// The lengths and times of the manifest and of its settings.
    pub(super) stamps: Vec<(u64, Option<SystemTime>)>,
}

/// A change of the components.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Change {
    /// The component of the module starts, with this manifest.
    Start(String, PathBuf),
    /// The component of the module is stopped.
    Stop(String),
}

/// The end of a component.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ComponentEnd {
    /// Its files are faulty: it ends again until they change.
    Faulty,
    Other,
}

/// The modules by their names.
#[derive(Debug, Default)]
pub(super) struct ModuleFolder {
    modules: BTreeMap<String, ModuleState>,
    /// The manifests at the last look.
    last: BTreeMap<String, ModuleFile>,
}

#[derive(Debug)]
enum ModuleState {
    /// The file is new or has changed; it may still be written.
    Settling(ModuleFile),
    /// The component runs since a time.
    Running {
        file: ModuleFile,
        since: Duration,
        pause: Duration,
    },
    /// The component is being stopped.
    Stopping,
    /// The component has ended by itself. It starts again at a time, or when the file changes.
    Ended {
        file: ModuleFile,
        again: Option<Duration>,
        pause: Duration,
    },
}

impl ModuleFolder {
    /// Takes the manifests in the folder. A manifest, its change and its removal count when two
    /// looks in a row find the same: editors replace a file in two steps.
    pub(super) fn look(
        &mut self,
        found: &BTreeMap<String, ModuleFile>,
        now: Duration,
    ) -> Vec<Change> {
        let last = std::mem::replace(&mut self.last, found.clone());
        let mut changes = Vec::new();
        for (name, file) in found {
            if !self.modules.contains_key(name) {
                let state = ModuleState::Settling(file.clone());
                self.modules.insert(name.clone(), state);
                continue;
            }
            let Some(state) = self.modules.get_mut(name) else {
                continue;
            };
            let start = |pause| {
                let running = ModuleState::Running {
                    file: file.clone(),
                    since: now,
                    pause,
                };
                (running, Change::Start(name.clone(), file.path.clone()))
            };
            let (next, change) = match state {
                ModuleState::Settling(before) if before == file => start(SHORTEST_PAUSE),
                ModuleState::Ended {
                    file: before,
                    again: Some(again),
                    pause,
                } if before == file && *again <= now => start(*pause),
                ModuleState::Running { file: before, .. }
                    if before != file && last.get(name) == Some(file) =>
                {
                    (ModuleState::Stopping, Change::Stop(name.clone()))
                }
                ModuleState::Ended { file: before, .. } | ModuleState::Settling(before)
                    if before != file =>
                {
                    *state = ModuleState::Settling(file.clone());
                    continue;
                }
                ModuleState::Settling(_)
                | ModuleState::Running { .. }
                | ModuleState::Stopping
                | ModuleState::Ended { .. } => continue,
            };
            *state = next;
            changes.push(change);
        }
        self.modules.retain(|name, state| {
            if found.contains_key(name) {
                return true;
            }
            if matches!(state, ModuleState::Running { .. }) {
                if last.contains_key(name) {
                    return true;
                }
                *state = ModuleState::Stopping;
                changes.push(Change::Stop(name.clone()));
            }
            matches!(state, ModuleState::Stopping)
        });
        changes
    }

    /// Takes the end of a component.
    pub(super) fn ended(&mut self, name: &str, end: ComponentEnd, now: Duration) {
        let Some(state) = self.modules.remove(name) else {
            return;
        };
        // A component that was stopped starts again if its file is there at the next looks.
        let ModuleState::Running { file, since, pause } = state else {
            return;
        };
        let has_run = now.saturating_sub(since) >= LONG_RUN;
        let pause = if has_run { SHORTEST_PAUSE } else { pause };
        let again = (end == ComponentEnd::Other).then(|| now.saturating_add(pause));
        let pause = pause.saturating_mul(2).min(LONGEST_PAUSE);
        let ended = ModuleState::Ended { file, again, pause };
        self.modules.insert(name.to_owned(), ended);
    }
}

/// The numbers of the modules in the space. A number is never given to another module: its topics
/// command a machine.
#[derive(Debug, Default, serde::Serialize, serde::Deserialize)]
#[serde(transparent)]
pub(super) struct ModuleNumbers(BTreeMap<String, u16>);

impl ModuleNumbers {
    /// Returns the number of a module, and whether it is new. `None` if all are in use.
    pub(super) fn of(&mut self, name: &str, (first, most): (u16, u16)) -> Option<(u16, bool)> {
        if let Some(number) = self.0.get(name) {
            return Some((*number, false));
        }
        let all = (0..most).filter_map(|place| first.checked_add(place));
        let free = all
            .into_iter()
            .find(|number| !self.0.values().any(|used| used == number))?;
        self.0.insert(name.to_owned(), free);
        Some((free, true))
    }

    /// Forgets the number of a module that could not be stored.
    pub(super) fn forget(&mut self, name: &str) {
        self.0.remove(name);
    }
}

const SHORTEST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_secs(60);
/// After a longer run, the next pause is the shortest again.
const LONG_RUN: Duration = Duration::from_secs(60);

#[cfg(test)]
mod tests {
    use super::*;

    fn found(files: &[(&str, u64)]) -> BTreeMap<String, ModuleFile> {
        let file = |(name, length): &(&str, u64)| {
            let file = ModuleFile {
                path: format!("{name}.mtp").into(),
                stamps: vec![(*length, None)],
            };
            ((*name).to_owned(), file)
        };
        files.iter().map(file).collect()
    }

    fn start(name: &str) -> Change {
        Change::Start(name.to_owned(), format!("{name}.mtp").into())
    }

    fn stop(name: &str) -> Change {
        Change::Stop(name.to_owned())
    }

    fn at(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn a_manifest_starts_a_component_when_it_is_written_and_stops_it_when_it_is_removed() {
        let mut folder = ModuleFolder::default();
        assert_eq!(folder.look(&found(&[("a", 1)]), at(0)), []);
        assert_eq!(folder.look(&found(&[("a", 2)]), at(1)), [], "it grows");
        assert_eq!(folder.look(&found(&[("a", 2)]), at(2)), [start("a")]);
        assert_eq!(folder.look(&found(&[("a", 2)]), at(3)), []);
        assert_eq!(folder.look(&found(&[]), at(4)), []);
        assert_eq!(folder.look(&found(&[]), at(5)), [stop("a")]);
        assert_eq!(folder.look(&found(&[]), at(6)), [], "it is stopped once");
        // It comes back while the component still ends: no second one starts beside it.
        assert_eq!(folder.look(&found(&[("a", 2)]), at(7)), []);
        assert_eq!(folder.look(&found(&[("a", 2)]), at(8)), []);
        folder.ended("a", ComponentEnd::Other, at(9));
        assert_eq!(folder.look(&found(&[("a", 2)]), at(10)), []);
        assert_eq!(folder.look(&found(&[("a", 2)]), at(11)), [start("a")]);
    }

    #[test]
    fn a_component_goes_on_when_its_manifest_is_missing_or_different_at_one_look_only() {
        let mut folder = ModuleFolder::default();
        let files = found(&[("a", 1)]);
        folder.look(&files, at(0));
        assert_eq!(folder.look(&files, at(1)), [start("a")]);
        let others = [found(&[]), found(&[("a", 0)]), found(&[("a", 2)])];
        for (other, second) in others.iter().zip((2..).step_by(2)) {
            assert_eq!(folder.look(other, at(second)), [], "{other:?}");
            assert_eq!(folder.look(&files, at(second + 1)), [], "{other:?}");
        }
        // Two looks that find different changes do not agree either.
        for other in others.iter().rev() {
            assert_eq!(folder.look(other, at(10)), [], "{other:?}");
        }
        assert_eq!(folder.look(&found(&[]), at(11)), [stop("a")]);
    }

    #[test]
    fn a_manifest_that_changes_is_stopped_before_it_starts_again() {
        let mut folder = ModuleFolder::default();
        for second in 0..2 {
            folder.look(&found(&[("a", 1), ("b", 1)]), at(second));
        }
        let changed = found(&[("a", 2), ("b", 1)]);
        assert_eq!(folder.look(&changed, at(2)), []);
        assert_eq!(folder.look(&changed, at(3)), [stop("a")]);
        folder.ended("a", ComponentEnd::Other, at(4));
        assert_eq!(folder.look(&changed, at(5)), []);
        assert_eq!(folder.look(&changed, at(6)), [start("a")]);
    }

    #[test]
    fn a_component_that_ends_by_itself_starts_again_later_and_a_faulty_one_with_its_file() {
        let mut folder = ModuleFolder::default();
        let files = found(&[("a", 1)]);
        folder.look(&files, at(0));
        assert_eq!(folder.look(&files, at(1)), [start("a")]);
        folder.ended("a", ComponentEnd::Other, at(2));
        assert_eq!(folder.look(&files, at(2)), []);
        assert_eq!(folder.look(&files, at(3)), [start("a")]);
        folder.ended("a", ComponentEnd::Other, at(4));
        assert_eq!(folder.look(&files, at(5)), [], "the pause is longer");
        assert_eq!(folder.look(&files, at(6)), [start("a")]);
        folder.ended("a", ComponentEnd::Faulty, at(7));
        assert_eq!(folder.look(&files, at(1000)), []);
        let mended = found(&[("a", 2)]);
        assert_eq!(folder.look(&mended, at(1001)), []);
        assert_eq!(folder.look(&mended, at(1002)), [start("a")]);
    }

    #[test]
    fn a_module_keeps_its_number_and_no_other_one_gets_it() {
        let mut numbers = ModuleNumbers::default();
        assert_eq!(numbers.of("a", (60, 2)), Some((60, true)));
        assert_eq!(numbers.of("b", (60, 2)), Some((61, true)));
        assert_eq!(numbers.of("c", (60, 2)), None);
        assert_eq!(numbers.of("a", (60, 2)), Some((60, false)));
        let text = serde_json::to_string(&numbers).unwrap();
        let mut read: ModuleNumbers = serde_json::from_str(&text).unwrap();
        assert_eq!(read.of("b", (70, 2)), Some((61, false)));
        assert_eq!(read.of("c", (70, 2)), Some((70, true)));
        assert_eq!(read.of("d", (65_535, 2)), Some((65_535, true)));
        assert_eq!(
            read.of("e", (65_535, 2)),
            None,
            "there is no number behind it"
        );
    }
}

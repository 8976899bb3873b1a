//! `ua-component modules`: a component for each manifest (MTP) in a folder, as long as it is there.

mod folder;

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fs;
use std::io::{self, Read as _};
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use plant_opcua::synced;
use rustix::process::{Pid, Signal, kill_process};
use tokio::process::{Child, Command};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::oneshot;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};

use folder::{Change, ComponentEnd, ModuleFile, ModuleFolder, ModuleNumbers};

use crate::verb;

/// The argument that selects the folder.
pub(crate) const VERB: &str = "modules";

/// Runs a component for each manifest of a process module (.aml, .mtp, .amlx) in a folder.
///
/// A manifest that is copied into the folder starts a component with its services as skills; a
/// manifest that is removed stops it. The name of the file is the name of the component. Keys of
/// `mtp` such as `capabilities` and `endpoint` are in NAME.yaml beside the manifest.
#[derive(Debug, clap::Parser)]
#[command(name = "ua-component modules", version = build_info::version())]
struct Modules {
    /// The folder
    #[arg(value_name = "FOLDER")]
    folder: PathBuf,
    /// The first namespace in the space; each module has one of its own, and keeps it
    #[arg(long, value_name = "NUMBER", default_value = "60", value_parser = clap::value_parser!(u16).range(1..))]
    first: u16,
    /// The number of namespaces for modules
    #[arg(long, value_name = "COUNT", default_value = "16", value_parser = clap::value_parser!(u16).range(1..=64))]
    most: u16,
    /// Where the numbers and the YAML of the components are kept. Without it FOLDER/.ua-component
    #[arg(long, value_name = "DIR")]
    state: Option<PathBuf>,
    /// The beginning of the ApplicationUris, which differ in the network
    #[arg(long, value_name = "URI", default_value = "urn:ua-bridge:module:")]
    uri: String,
    /// Arguments of each component, as `-- --interface eth0 --lds none`
    #[arg(last = true, value_name = "ARGUMENTS")]
    component: Vec<OsString>,
}

/// Runs the components of a folder until SIGINT or SIGTERM.
pub(crate) fn run(arguments: impl Iterator<Item = OsString>) -> ExitCode {
    verb::run(arguments, Supervisor::run)
}

/// The components of a folder.
struct Supervisor {
    settings: Modules,
    state: PathBuf,
    /// Claims the state folder. Each component has a clone.
    claim: fs::File,
    numbers: ModuleNumbers,
    folder: ModuleFolder,
    running: JoinSet<(String, ComponentEnd)>,
    stops: BTreeMap<String, oneshot::Sender<()>>,
    /// The findings of the last look, each of which is printed once.
    findings: BTreeSet<String>,
}

impl Supervisor {
    /// Claims the state folder, and reads its numbers.
    ///
    /// # Errors
    /// The folder cannot be used, or is claimed.
    fn new(settings: Modules) -> io::Result<Self> {
        let usual = || settings.folder.join(".ua-component");
        let state = settings.state.clone().unwrap_or_else(usual);
        fs::create_dir_all(&state).map_err(|error| about(&state, &error))?;
        let file = state.join(CLAIM);
        let claim = synced::claim(&file).map_err(|error| about(&file, &error))?;
        let claim = claim.ok_or_else(|| {
            let why = format!(
                "in use by another `ua-component modules`, or by components that a killed one \
                 left: stop them (`fuser -v {}` lists them), because each module has one component",
                file.display()
            );
            about(&state, &why)
        })?;
        Ok(Self {
            numbers: read_numbers(&state.join(NUMBERS))?,
            settings,
            state,
            claim,
            folder: ModuleFolder::default(),
            running: JoinSet::new(),
            stops: BTreeMap::new(),
            findings: BTreeSet::new(),
        })
    }

    async fn run(settings: Modules) -> io::Result<()> {
        let (mut interrupt, mut terminate) = (
            signal(SignalKind::interrupt())?,
            signal(SignalKind::terminate())?,
        );
        let mut all = Self::new(settings)?;
        let began = Instant::now();
        let mut looks = interval(LOOK_EVERY);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                _ = interrupt.recv() => break,
                _ = terminate.recv() => break,
                _ = looks.tick() => all.look(began.elapsed()),
                Some(Ok((name, end))) = all.running.join_next() => {
                    all.stops.remove(&name);
                    all.folder.ended(&name, end, began.elapsed());
                }
            }
        }
        // All end together; each has its own limit.
        all.stops.clear();
        while all.running.join_next().await.is_some() {}
        Ok(())
    }

    /// Looks into the folder, and starts and stops components.
    fn look(&mut self, now: Duration) {
        let mut findings = BTreeSet::new();
        match scan(&self.settings.folder, &mut findings) {
            Ok(found) => {
                for change in self.folder.look(&found, now) {
                    match change {
                        Change::Stop(name) => {
                            crate::print(&format!(
                                "{name}: the manifest is gone or has changed; its component is stopped\n"
                            ));
                            self.stops.remove(&name);
                        }
                        Change::Start(name, manifest) => {
                            let end = match self.start(&name, &manifest) {
                                Ok(()) => continue,
                                Err(error) => error,
                            };
                            findings.insert(format!("{name}: {end}"));
                            self.folder.ended(&name, ComponentEnd::Other, now);
                        }
                    }
                }
            }
            // A folder that cannot be read keeps its components.
            Err(error) => drop(findings.insert(format!("cannot look into the folder: {error}"))),
        }
        for new in findings.difference(&self.findings) {
            crate::print(&format!("error: {new}\n"));
        }
        self.findings = findings;
    }

    /// Starts the component of a manifest.
    fn start(&mut self, name: &str, manifest: &Path) -> io::Result<()> {
        let Modules { first, most, .. } = self.settings;
        let number = self.numbers.of(name, (first, most));
        let (number, is_new) = number.ok_or_else(|| {
            let file = self.state.join(NUMBERS);
            io::Error::other(format!(
                "all {most} namespaces from {first} on belong to other modules, also to removed ones: raise \
                 --most, or remove modules that do not come back from {}",
                file.display()
            ))
        })?;
        if is_new {
            let file = self.state.join(NUMBERS);
            let text = serde_json::to_string_pretty(&self.numbers).map_err(io::Error::from);
            let written = text.and_then(|text| write_whole(&file, &text));
            if let Err(error) = written {
                // After a restart, another module would get a number that is not in the file.
                self.numbers.forget(name);
                return Err(error);
            }
        }
        let settings = read_settings(&manifest.with_extension("yaml"))?;
        let manifest = fs::canonicalize(manifest)?;
        let uri = format!("{}{name}", self.settings.uri);
        let yaml = component_yaml((name, &uri, number), &manifest, settings.as_deref())?;
        let file = self.state.join(format!("{name}.yaml"));
        write_whole(&file, &yaml)?;
        let child = Command::new(std::env::current_exe()?)
            .arg0("ua-component")
            .arg(&file)
            .args(&self.settings.component)
            // It reads nothing. It keeps the claim if this program is killed, so that no second
            // component starts for its module.
            .stdin(self.claim.try_clone()?)
            // Ctrl-C ends this program, which then ends the components.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()?;
        crate::print(&format!(
            "{name}: its component starts, namespace {number} of the space\n"
        ));
        let (stop, stopped) = oneshot::channel();
        self.stops.insert(name.to_owned(), stop);
        self.running.spawn(watched(name.to_owned(), child, stopped));
        Ok(())
    }
}

/// Waits for the end of a component. When `stopped` completes, the component is ended by SIGTERM,
/// so that it halts its runs.
async fn watched(
    name: String,
    mut child: Child,
    stopped: oneshot::Receiver<()>,
) -> (String, ComponentEnd) {
    let status = tokio::select! {
        status = child.wait() => status,
        _ = stopped => {
            let pid = child.id().and_then(|id| Pid::from_raw(i32::try_from(id).ok()?));
            if let Some(pid) = pid {
                // An error means that it has ended.
                let _sent = kill_process(pid, Signal::TERM);
            }
            match timeout(STOP_WITHIN, child.wait()).await {
                Ok(_status) => {}
                Err(_elapsed) => {
                    let seconds = STOP_WITHIN.as_secs();
                    crate::print(&format!("error: {name}: its component has not ended within {seconds} s and is killed; look at the module\n"));
                    // An error means that it has ended.
                    let _killed = child.kill().await;
                }
            }
            return (name, ComponentEnd::Other);
        }
    };
    let (end, told) = match &status {
        Ok(status) if status.code().is_some_and(|code| FAULTY.contains(&code)) => (
            ComponentEnd::Faulty,
            "its files are faulty; it starts again when they change".to_owned(),
        ),
        Ok(status) => {
            let how = match (status.code(), status.signal()) {
                (Some(code), _) => format!("with {code}"),
                (None, Some(signal)) => format!("by the signal {signal}"),
                (None, None) => "in an unknown way".to_owned(),
            };
            (
                ComponentEnd::Other,
                format!("it ended {how}, and starts again soon"),
            )
        }
        Err(error) => (
            ComponentEnd::Other,
            format!("its end is not known: {error}"),
        ),
    };
    crate::print(&format!("error: {name}: {told}\n"));
    (name, end)
}

/// Returns the manifests in a folder by their names.
fn scan(
    folder: &Path,
    findings: &mut BTreeSet<String>,
) -> io::Result<BTreeMap<String, ModuleFile>> {
    let mut found: BTreeMap<String, ModuleFile> = BTreeMap::new();
    for path in entries(folder, MOST_ENTRIES)? {
        let extension = path.extension().and_then(|one| one.to_str());
        let is_manifest = extension.is_some_and(|one| {
            let all = ["aml", "mtp", "amlx"];
            all.iter().any(|known| one.eq_ignore_ascii_case(known))
        });
        if !is_manifest {
            continue;
        }
        let name = path.file_stem().and_then(|one| one.to_str());
        let Some(name) = name.filter(|name| is_name(name)) else {
            let file = path.display();
            findings.insert(format!(
                "{file}: a module is named by its file: use up to 64 letters, digits, - and _"
            ));
            continue;
        };
        if let Some(other) = found.get(name) {
            let (file, other) = (path.display(), other.path.display());
            findings.insert(format!(
                "{file}: the module {name} is described by {other} too"
            ));
            continue;
        }
        let stamp = |path: &Path| {
            let about = fs::metadata(path).ok()?;
            Some((about.len(), about.modified().ok()))
        };
        let files = [stamp(&path), stamp(&path.with_extension("yaml"))];
        let file = ModuleFile {
            stamps: files.into_iter().flatten().collect(),
            path: path.clone(),
        };
        found.insert(name.to_owned(), file);
    }
    Ok(found)
}

/// Returns the sorted paths of all entries of a folder. A part of them would not do: a module
/// whose manifest is left out would be stopped.
fn entries(folder: &Path, most: usize) -> io::Result<Vec<PathBuf>> {
    let mut paths: Vec<PathBuf> = fs::read_dir(folder)?
        .take(most.saturating_add(1))
        .map(|entry| entry.map(|entry| entry.path()))
        .collect::<Result<_, _>>()?;
    if paths.len() > most {
        let fault = format!("it has more than {most} entries: move other files out of it");
        return Err(about(folder, &fault));
    }
    paths.sort();
    Ok(paths)
}

fn is_name(name: &str) -> bool {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    (1..=64).contains(&name.len()) && name.chars().all(is_plain)
}

/// Returns the YAML of the component of a module. Texts are quoted as in JSON, which YAML reads
/// too.
fn component_yaml(
    (name, uri, number): (&str, &str, u16),
    manifest: &Path,
    settings: Option<&str>,
) -> io::Result<String> {
    let manifest = manifest.to_str().ok_or_else(|| {
        io::Error::other(format!("{} is no UTF-8: rename it", manifest.display()))
    })?;
    let mut text = format!(
        "# Written by `ua-component modules` from the manifest: changes are lost.\n\
         component: {}\napplication_uri: {}\nnamespace: {number}\nendpoint: opc.tcp://127.0.0.1:0\n\
         device:\n  mtp:\n    manifest: {}\n",
        serde_json::to_string(name)?,
        serde_json::to_string(uri)?,
        serde_json::to_string(manifest)?,
    );
    for line in settings.unwrap_or_default().lines() {
        text.push_str(&format!("    {line}\n"));
    }
    Ok(text)
}

/// Returns the settings beside a manifest, if there are any.
fn read_settings(path: &Path) -> io::Result<Option<String>> {
    // The opening of a pipe would wait for its writer, and all components would wait with it.
    match fs::metadata(path) {
        Ok(found) if found.is_file() => {}
        Ok(_) => return Err(about(path, &"it is no regular file: remove it")),
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(about(path, &error)),
    }
    let file = fs::File::open(path).map_err(|error| about(path, &error))?;
    let mut text = String::new();
    let read = file.take(LARGEST_SETTINGS).read_to_string(&mut text);
    let length = read.map_err(|error| about(path, &error))?;
    if u64::try_from(length).is_ok_and(|length| length == LARGEST_SETTINGS) {
        let fault = format!("it has {LARGEST_SETTINGS} bytes or more");
        return Err(about(path, &fault));
    }
    Ok(Some(text))
}

/// Reads the numbers of the modules. A file that cannot be read is an error: other numbers would
/// command other machines.
fn read_numbers(path: &Path) -> io::Result<ModuleNumbers> {
    match fs::read_to_string(path) {
        Ok(text) => serde_json::from_str(&text).map_err(|error| about(path, &error)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(ModuleNumbers::default()),
        Err(error) => Err(about(path, &error)),
    }
}

/// Replaces a file as a whole.
fn write_whole(path: &Path, text: &str) -> io::Result<()> {
    synced::replace(path, text.as_bytes()).map_err(|error| about(path, &error))
}

fn about(path: &Path, error: &dyn std::fmt::Display) -> io::Error {
    io::Error::other(format!("{}: {error}", path.display()))
}

const NUMBERS: &str = "numbers.json";
/// The file in the state folder that is locked.
const CLAIM: &str = "running";
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// Time for a component to halt its runs and to end.
const STOP_WITHIN: Duration = Duration::from_secs(30);
/// The exit codes of a component with faulty files: usage, data and configuration.
const FAULTY: [i32; 3] = [64, 65, 78];
const MOST_ENTRIES: usize = 10_000;
const LARGEST_SETTINGS: u64 = 64 << 10;

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;

    #[test]
    fn the_component_of_a_manifest_has_its_settings_and_can_be_read() {
        let manifest = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../tests/data/mtp/stage.aml"
        );
        let settings = "capabilities:\n  Solo/Polka: [urn:example:capability:dance]\nwithin: 3 s\n";
        let identity = ("stage", "urn:example:stage", 60);
        let text = component_yaml(identity, Path::new(manifest), Some(settings)).unwrap();
        let read = |text: &str| {
            let component = skills::Component::from_yaml_with(text, Path::new(""), &devices::Kinds);
            component.map_err(|findings| findings.render("stage.yaml", text))
        };
        let component = read(&text).unwrap();
        assert_eq!(component.name, "stage");
        let mut names = component.skills.iter().map(|skill| &*skill.name);
        assert!(names.any(|name| name == "Solo-Polka"), "{text}");
        let wrong = component_yaml(identity, Path::new(manifest), Some("capability: 1\n"));
        assert!(read(&wrong.unwrap()).unwrap_err().contains("capability"));
    }

    #[test]
    fn a_folder_has_a_module_for_each_manifest_and_findings_for_the_others() {
        let folder = std::env::temp_dir().join(format!("ua-modules-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        for name in ["b.mtp", "a.AML", "a.mtp", "notes.txt", "a b.aml", "b.yaml"] {
            fs::write(folder.join(name), name).unwrap();
        }
        let mut findings = BTreeSet::new();
        let found = scan(&folder, &mut findings).unwrap();
        let names: Vec<&str> = found.keys().map(String::as_str).collect();
        assert_eq!(names, ["a", "b"]);
        let of = |name: &str| found.get(name).map_or(0, |file| file.stamps.len());
        assert_eq!((of("a"), of("b")), (1, 2), "the settings count too");
        let findings: Vec<String> = findings.into_iter().collect();
        assert!(findings[0].contains("a b.aml: a module is named by its file"));
        assert!(
            findings[1].contains("a.mtp: the module a is described by"),
            "{findings:?}"
        );
        // A folder with too many entries is not read in part.
        assert_eq!(entries(&folder, 6).unwrap().len(), 6);
        let why = entries(&folder, 5).unwrap_err().to_string();
        assert!(why.contains("more than 5 entries"), "{why}");
        fs::remove_dir_all(&folder).unwrap();
    }

    fn of_state(state: &Path) -> Modules {
        let state = state.to_str().unwrap();
        Modules::try_parse_from(["modules", "/nowhere", "--state", state]).unwrap()
    }

    #[test]
    fn a_second_supervisor_of_a_state_folder_is_refused_while_components_of_the_first_run() {
        let state = std::env::temp_dir().join(format!("ua-claimed-{}", std::process::id()));
        let first = Supervisor::new(of_state(&state)).unwrap();
        let refused = || Supervisor::new(of_state(&state)).err().unwrap().to_string();
        let why = refused();
        assert!(why.contains("ua-claimed"), "{why}");
        assert!(
            why.contains("in use by another `ua-component modules`"),
            "{why}"
        );
        // A killed supervisor leaves its components.
        let mut component = std::process::Command::new("sleep")
            .arg("60")
            .stdin(first.claim.try_clone().unwrap())
            .spawn()
            .unwrap();
        drop(first);
        assert_eq!(refused(), why);
        component.kill().unwrap();
        component.wait().unwrap();
        // A process that another test forks has the file open until it executes its program.
        let claimed = (0..200_000).any(|_| Supervisor::new(of_state(&state)).is_ok());
        assert!(claimed, "{}", refused());
        fs::remove_dir_all(&state).unwrap();
    }

    #[test]
    fn a_number_that_cannot_be_stored_starts_no_component_also_at_the_next_try() {
        let state = std::env::temp_dir().join(format!("ua-state-{}", std::process::id()));
        let mut all = Supervisor::new(of_state(&state)).unwrap();
        fs::remove_dir_all(&state).unwrap();
        for _ in 0..2 {
            let error = all.start("a", Path::new("/nowhere/a.mtp")).unwrap_err();
            assert!(error.to_string().contains("numbers.json"), "{error}");
        }
        fs::create_dir_all(&state).unwrap();
        // The number is stored; only the manifest is missing now.
        all.start("a", Path::new("/nowhere/a.mtp")).unwrap_err();
        let mut stored = read_numbers(&state.join(NUMBERS)).unwrap();
        assert_eq!(stored.of("a", (60, 16)), Some((60, false)));
        fs::remove_dir_all(&state).unwrap();
    }

    #[test]
    fn settings_are_read_from_a_regular_file_only() {
        let folder = std::env::temp_dir().join(format!("ua-settings-{}", std::process::id()));
        fs::create_dir_all(folder.join("folder.yaml")).unwrap();
        fs::write(folder.join("a.yaml"), "within: 3 s").unwrap();
        let read = |name: &str| read_settings(&folder.join(name));
        assert_eq!(read("a.yaml").unwrap().as_deref(), Some("within: 3 s"));
        assert_eq!(read("b.yaml").unwrap(), None);
        let why = read("folder.yaml").unwrap_err().to_string();
        assert!(why.contains("folder.yaml: it is no regular file"), "{why}");
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn numbers_that_cannot_be_read_are_an_error() {
        let path = std::env::temp_dir().join(format!("ua-numbers-{}.json", std::process::id()));
        assert!(read_numbers(&path).is_ok());
        write_whole(&path, "{\"a\": 60, \"a\":").unwrap();
        let why = read_numbers(&path).unwrap_err().to_string();
        assert!(why.contains("ua-numbers"), "{why}");
        fs::remove_file(&path).unwrap();
    }
}

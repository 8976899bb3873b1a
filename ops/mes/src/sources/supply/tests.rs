use http_client::StatusCode;
use knowledge::{Knowledge, SourceFiles};

use super::*;
use crate::settings::Settings;

const URL: &str = "http://anna:secret@127.0.0.1:1/sets/{uri}.xml?key=secret";

/// Returns a NodeSet that requires others, each with a date.
fn node_set(namespace: &str, date: &str, required: &[(&str, &str)]) -> Bytes {
    let required = required.iter().map(|(other, date)| {
        format!("<RequiredModel ModelUri=\"{other}\" PublicationDate=\"{date}\"/>")
    });
    let required: String = required.collect();
    let text = format!(
        "<UANodeSet><NamespaceUris><Uri>{namespace}</Uri></NamespaceUris>
         <Models><Model ModelUri=\"{namespace}\" PublicationDate=\"{date}\">{required}</Model></Models>
         <UAObjectType NodeId=\"ns=1;i=1\" BrowseName=\"1:T\"/></UANodeSet>"
    );
    Bytes::from(text)
}

/// A MES with a NodeSet in its YAML.
struct Bench {
    sources: MesSources,
    folder: PathBuf,
}

impl Bench {
    /// Creates a folder that is named for a test, with the NodeSet `urn:robotics`.
    fn new(name: &str, required: &[(&str, &str)]) -> Self {
        let folder = std::env::temp_dir().join(format!("{name}-{}", std::process::id()));
        drop(fs::remove_dir_all(&folder));
        fs::create_dir_all(&folder).unwrap();
        let robotics = node_set("urn:robotics", "2023-01-01", required);
        fs::write(folder.join("robotics.xml"), robotics).unwrap();
        Self {
            sources: Self::sources(None),
            folder,
        }
    }

    fn sources(cache: Option<PathBuf>) -> MesSources {
        MesSources::new(Arc::new(Knowledge::new().unwrap())).cached_in(cache)
    }

    /// Restarts the program, which has the folder for fetched files.
    fn restart(&mut self) {
        self.sources = Self::sources(Some(self.folder.clone()));
    }

    fn read(&self, keys: &str) {
        let text = format!("mes: m\napplication_uri: urn:x\nnamespace: 5\n{keys}\n");
        let settings = Settings::from_yaml(&text, &self.folder).unwrap();
        self.sources.read(&settings);
    }

    fn read_with_url(&self) {
        self.read(&format!(
            "nodesets: [robotics.xml]\nnodeset_folder: '{URL}'"
        ));
    }

    fn next(&self) -> Option<String> {
        self.sources.next_fetch().map(|(_, namespace)| namespace)
    }

    /// Delivers a file for the namespace that is fetched next.
    fn deliver(&self, namespace: &str, file: Result<Bytes, NodeSetFetchError>) {
        let (url, wanted) = self.sources.next_fetch().unwrap();
        assert_eq!(wanted, namespace);
        self.sources.deliver(&url, namespace, file);
    }

    /// Returns the namespaces of the NodeSets in the graph.
    fn names(&self) -> Vec<String> {
        let known = self.sources.known_node_sets().into_keys();
        let ours = |name: &String| *name != skills::model::NAMESPACE;
        known.filter(ours).collect()
    }

    /// Returns the only finding with the NodeSet that it is about.
    fn finding(&self) -> (String, String) {
        let findings = self.sources.findings();
        let [found] = findings.as_slice() else {
            panic!("{findings:?}")
        };
        assert!(
            !found.refused && !found.what.contains("secret"),
            "{found:?}"
        );
        (found.source.clone(), found.what.clone())
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        drop(fs::remove_dir_all(&self.folder));
    }
}

const NOT_FOUND: NodeSetFetchError = NodeSetFetchError::Status(StatusCode::NOT_FOUND);
const UNAVAILABLE: NodeSetFetchError = NodeSetFetchError::Status(StatusCode::SERVICE_UNAVAILABLE);

#[test]
fn a_nodeset_is_completed_in_turn_and_a_failure_is_a_finding() {
    let bench = Bench::new("supply-turn", &[("urn:di", "2022-01-01")]);
    bench.read_with_url();
    assert_eq!(bench.names(), ["urn:robotics"]);
    let (source, what) = bench.finding();
    assert_eq!(source, "urn:robotics");
    let shown = "which is fetched from http://127.0.0.1:1/sets/{uri}.xml";
    assert!(what.ends_with(shown), "{what}");

    let di = node_set("urn:di", "2022-06-01", &[("urn:core", "2022-01-01")]);
    bench.deliver("urn:di", Ok(di));
    assert_eq!(bench.names(), ["urn:di", "urn:robotics"]);
    bench.deliver("urn:core", Err(NOT_FOUND));
    assert_eq!(bench.next(), None, "a namespace is tried once");
    let (source, what) = bench.finding();
    assert_eq!(source, "urn:di");
    assert!(what.starts_with("urn:di requires urn:core,"), "{what}");
    assert!(
        what.ends_with("{uri}.xml: the response is 404 Not Found"),
        "{what}"
    );

    // The signal tries again what is missing, and keeps what is there.
    bench.read_with_url();
    assert_eq!(bench.names(), ["urn:di", "urn:robotics"]);
    let core = node_set("urn:core", "2022-01-01", &[]);
    bench.deliver("urn:core", Ok(core));
    assert_eq!(bench.sources.findings(), []);
    assert_eq!(bench.next(), None);
    // Fetched NodeSets leave the graph with the NodeSet that requires them, or with the URL.
    bench.read("nodesets: [robotics.xml]");
    assert_eq!(bench.names(), ["urn:robotics"]);
    assert_eq!(bench.sources.findings(), []);
}

#[test]
fn a_file_of_another_model_and_an_older_version_are_findings() {
    let bench = Bench::new("supply-wrong", &[("urn:di", "2022-01-01"), ("urn:ia", "")]);
    bench.read_with_url();
    bench.deliver("urn:di", Ok(node_set("urn:ia", "", &[])));
    assert_eq!(bench.names(), ["urn:robotics"]);
    bench.deliver("urn:ia", Ok(node_set("urn:ia", "", &[])));
    let (_, what) = bench.finding();
    assert!(
        what.ends_with("the file is the NodeSet of urn:ia"),
        "{what}"
    );
    bench.read_with_url();
    bench.deliver("urn:di", Ok(node_set("urn:di", "2020-01-01", &[])));
    let (_, what) = bench.finding();
    let text = "requires urn:di in the version of 2022-01-01 or newer, and the NodeSet that is \
                there has the version of 2020-01-01";
    assert!(what.contains(text), "{what}");
}

#[test]
fn a_nodeset_that_is_added_is_completed_and_a_removed_one_is_not_fetched_again() {
    let bench = Bench::new("supply-added", &[]);
    bench.read_with_url();
    assert_eq!(bench.next(), None);
    let late = node_set("urn:late", "2023-01-01", &[("urn:di", "")]);
    let checked = bench.sources.check(SourceKind::NodeSet, "late", &late);
    let what = &checked.findings[0].what;
    assert!(
        checked.accepted && what.contains("urn:di, which is fetched"),
        "{what}"
    );
    assert_eq!(bench.next(), None, "a check fetches nothing");
    let put = SourceFiles::put(&bench.sources, SourceKind::NodeSet, "late", &late);
    assert_eq!(put, Ok(true));
    bench.deliver("urn:di", Ok(node_set("urn:di", "", &[])));
    assert_eq!(bench.names(), ["urn:di", "urn:late", "urn:robotics"]);
    bench.read_with_url();
    let all = ["urn:di", "urn:late", "urn:robotics"];
    assert_eq!(
        bench.names(),
        all,
        "it was added, as the NodeSet that requires it"
    );
    assert_eq!(
        bench.sources.remove(SourceKind::NodeSet, "urn:di"),
        Ok(true)
    );
    assert_eq!(bench.next(), None);
    let (_, what) = bench.finding();
    assert!(
        what.ends_with("it was removed; SIGHUP fetches it again"),
        "{what}"
    );
    bench.read_with_url();
    assert_eq!(bench.next().as_deref(), Some("urn:di"));
}

#[test]
fn a_nodeset_that_only_an_added_one_requires_comes_to_the_journal() {
    for is_cached in [true, false] {
        let mut bench = Bench::new("supply-journal", &[("urn:di", "")]);
        let (knowledge, _) = Knowledge::open(&bench.folder.join("store")).unwrap();
        let cache = is_cached.then(|| bench.folder.clone());
        bench.sources = MesSources::new(Arc::new(knowledge)).cached_in(cache);
        bench.read_with_url();
        bench.deliver("urn:di", Ok(node_set("urn:di", "", &[])));
        let late = node_set("urn:late", "2023-01-01", &[("urn:di", "")]);
        let put = SourceFiles::put(&bench.sources, SourceKind::NodeSet, "late", &late);
        assert_eq!(put, Ok(true));
        let is_lasting = || {
            let all = bench.sources.knowledge.sources().into_iter();
            let mut di = all.filter(|source| source.name == "urn:di");
            di.next().is_some_and(|di| di.lasting)
        };
        assert!(!is_lasting(), "the YAML requires it");
        let alone = node_set("urn:robotics", "2023-01-01", &[]);
        fs::write(bench.folder.join("robotics.xml"), alone).unwrap();
        bench.read_with_url();
        if !is_cached {
            bench.deliver("urn:di", Ok(node_set("urn:di", "", &[])));
        }
        assert!(is_lasting(), "in the cache: {is_cached}");
    }
}

#[test]
fn a_result_that_is_late_is_left_out() {
    let bench = Bench::new("supply-late", &[("urn:di", "")]);
    bench.read_with_url();
    let (url, _) = bench.sources.next_fetch().unwrap();
    bench.read("nodesets: [robotics.xml]");
    let di = node_set("urn:di", "", &[]);
    bench.sources.deliver(&url, "urn:di", Ok(di));
    assert_eq!(bench.names(), ["urn:robotics"]);
}

#[test]
fn fetched_files_complete_a_nodeset_after_a_restart() {
    let mut bench = Bench::new("supply-restart", &[("urn:di", "2022-01-01")]);
    bench.restart();
    bench.read_with_url();
    let di = node_set("urn:di", "2022-01-01", &[("urn:core", "")]);
    bench.deliver("urn:di", Ok(di));
    bench.deliver("urn:core", Ok(node_set("urn:core", "", &[])));
    bench.restart();
    bench.read_with_url();
    assert_eq!(bench.names(), ["urn:core", "urn:di", "urn:robotics"]);
    assert_eq!((bench.next(), bench.sources.findings()), (None, Vec::new()));

    // A file that is too old is fetched again, and is better than none.
    let newer = node_set("urn:robotics", "", &[("urn:di", "2024-01-01")]);
    fs::write(bench.folder.join("robotics.xml"), newer).unwrap();
    bench.restart();
    bench.read_with_url();
    assert_eq!(bench.names(), ["urn:robotics"]);
    bench.deliver("urn:di", Err(UNAVAILABLE));
    assert!(bench.names().contains(&"urn:di".to_owned()));
    let findings = bench.sources.findings();
    let mut older = findings.iter();
    assert!(
        older.any(|found| found.what.contains("has the version of 2022")),
        "{findings:?}"
    );

    // A damaged file is fetched again.
    let url: NodeSetUrl = URL.parse().unwrap();
    let file = bench.sources.cache_file(&url, "urn:di").unwrap();
    fs::write(file, "<UANodeSet").unwrap();
    bench.restart();
    bench.read_with_url();
    assert_eq!(bench.next().as_deref(), Some("urn:di"));
}

#[test]
fn fetches_are_bounded_in_depth_and_number() {
    let bench = Bench::new("supply-deep", &[("urn:1", "")]);
    bench.read_with_url();
    for number in 1..=DEEPEST {
        let (name, next) = (format!("urn:{number}"), format!("urn:{}", number + 1));
        bench.deliver(&name, Ok(node_set(&name, "", &[(&next, "")])));
    }
    assert_eq!(bench.next(), None);
    let (source, what) = bench.finding();
    assert_eq!(source, format!("urn:{DEEPEST}"));
    assert!(
        what.contains("more than 16 NodeSets require one another"),
        "{what}"
    );

    let names: Vec<String> = (0..=MOST_FETCHES)
        .map(|at| format!("urn:{at:03}"))
        .collect();
    let required: Vec<(&str, &str)> = names.iter().map(|name| (name.as_str(), "")).collect();
    let bench = Bench::new("supply-many", &required);
    bench.read_with_url();
    for name in names.iter().take(MOST_FETCHES) {
        bench.deliver(name, Ok(node_set(name, "", &[])));
    }
    assert_eq!(bench.next(), None);
    let (_, what) = bench.finding();
    assert!(what.contains("urn:064, which cannot be fetched"), "{what}");
    assert!(what.ends_with("at most 64 NodeSets are fetched"), "{what}");
}

#[test]
fn only_a_server_that_does_not_answer_is_asked_again_by_itself() {
    let bench = Bench::new("supply-retry", &[("urn:a", ""), ("urn:b", "")]);
    bench.read_with_url();
    bench.deliver("urn:a", Err(UNAVAILABLE));
    bench.deliver("urn:b", Err(NOT_FOUND));
    assert_eq!(bench.next(), None);
    assert!(bench.sources.retry());
    bench.deliver("urn:a", Err(NOT_FOUND));
    assert!(!bench.sources.retry());
    assert_eq!(bench.next(), None);
}

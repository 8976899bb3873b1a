//! The history in a file, from which it returns after a restart.
//!
//! The file has the same values as the memory, so that both have the same limits. A thread of its
//! own writes the changes of half a second as one transaction. After a crash, at most the last
//! second is missing, and the file is intact. The file also has the states of the alarms.

use std::collections::{HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use bytes::Bytes;
use mappings::TopicId;
use opcua::types::{DateTime, NodeId, StatusCode};
use redb::{Database, ReadableDatabase as _, ReadableTable as _, TableDefinition};
use tracing::{info, warn};
use uadp::Timestamp;

use crate::layout::TopicNode;
use crate::values::{SampleStamp, ShownValue};

/// A value in the file: its topic, its number and its content.
pub(crate) type StoredValue = (TopicId, u64, ShownValue);

/// The file of the history is unusable.
#[derive(Debug, thiserror::Error)]
#[error(
    "the history in {} (server.history.file) cannot be used: {why}; \
     give another file, or move this one away to start with an empty history",
    path.display()
)]
pub(crate) struct HistoryFileFault {
    path: PathBuf,
    why: String,
}

/// Writes the changes of the history to a file.
#[derive(Debug)]
pub(crate) struct HistoryFile {
    shared: Arc<Shared>,
    /// The conditions of the file until they are taken.
    conditions: HashMap<String, Vec<u8>>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    pending: Mutex<Pending>,
    changed: Condvar,
}

/// The changes that are not in the file.
#[derive(Debug, Default)]
struct Pending {
    values: Vec<StoredValue>,
    bytes: usize,
    /// The number of the oldest value of each topic that has dropped values.
    floors: HashMap<TopicId, u64>,
    /// The types of topics that were added after the start.
    shapes: HashMap<TopicId, String>,
    /// The changed conditions by their nodes; `None` for removed conditions.
    conditions: HashMap<String, Option<Vec<u8>>>,
    /// Number of values that were not stored, because the file could not be written.
    lost: u64,
    is_over: bool,
}

impl HistoryFile {
    /// Opens the file or creates it. Also returns its values of `topics`, by topic and in the order
    /// of their arrival. Values of other topics, and of topics that had other types, are removed.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read or written, or is used by another program.
    pub(crate) fn open<'t>(
        path: &Path,
        topics: impl Iterator<Item = &'t TopicNode>,
    ) -> Result<(Self, Vec<StoredValue>), HistoryFileFault> {
        let fault = |why: String| HistoryFileFault {
            path: path.to_owned(),
            why,
        };
        if let Some(folder) = path
            .parent()
            .filter(|folder| !folder.as_os_str().is_empty())
        {
            fs::create_dir_all(folder).map_err(|error| fault(error.to_string()))?;
        }
        let database = open(path).map_err(|error| fault(error.to_string()))?;
        let shapes: HashMap<u64, String> = topics
            .filter(|topic| topic.historizing)
            .map(|topic| (key(topic.topic), shape(topic)))
            .collect();
        let loaded = load(&database, &shapes).map_err(|error| fault(error.to_string()))?;
        let (stored, conditions) = loaded;
        info!(
            file = %path.display(),
            values = stored.len(),
            "the history is kept in a file"
        );
        let shared = Arc::new(Shared::default());
        let (changes, file) = (Arc::clone(&shared), path.to_owned());
        let thread = std::thread::Builder::new().name("history".to_owned());
        let thread = thread.spawn(move || changes.write_to(database, &file));
        let thread = thread.map_err(|error| fault(error.to_string()))?;
        let store = Self {
            shared,
            conditions,
            thread: Some(thread),
        };
        Ok((store, stored))
    }

    /// Returns the conditions of the file, and stores further ones there.
    pub(crate) fn take_conditions(&mut self) -> StoredConditions {
        StoredConditions {
            stored: std::mem::take(&mut self.conditions),
            shared: Some(Arc::clone(&self.shared)),
        }
    }

    /// Adds a value.
    pub(crate) fn keep(&self, topic: TopicId, number: u64, shown: &ShownValue) {
        let size = size(shown);
        let mut pending = self.shared.lock();
        if pending.bytes + size > MOST_PENDING {
            pending.lost += 1;
            return;
        }
        pending.bytes += size;
        pending.values.push((topic, number, shown.clone()));
        drop(pending);
        self.shared.changed.notify_one();
    }

    /// Stores the type of a new topic, so that a restart recognizes values of another type.
    pub(crate) fn describe(&self, topic: &TopicNode) {
        let shape = shape(topic);
        self.shared.lock().shapes.insert(topic.topic, shape);
        self.shared.changed.notify_one();
    }

    /// Removes the values of a topic with a lower number.
    pub(crate) fn remove_before(&self, topic: TopicId, number: u64) {
        self.shared.lock().floors.insert(topic, number);
        self.shared.changed.notify_one();
    }
}

/// The conditions in the file. Without a file, nothing is stored.
#[derive(Debug, Default)]
pub(crate) struct StoredConditions {
    stored: HashMap<String, Vec<u8>>,
    shared: Option<Arc<Shared>>,
}

impl StoredConditions {
    /// Returns the condition of a node as it was stored before the start.
    pub(crate) fn take(&mut self, node: &NodeId) -> Option<Vec<u8>> {
        self.stored.remove(&node.to_string())
    }

    /// Stores a condition.
    pub(crate) fn keep(&self, node: &NodeId, bytes: Vec<u8>) {
        self.change(node.to_string(), Some(bytes));
    }

    /// Removes a condition.
    pub(crate) fn remove(&self, node: &NodeId) {
        self.change(node.to_string(), None);
    }

    /// Returns true if conditions are stored.
    pub(crate) const fn is_kept(&self) -> bool {
        self.shared.is_some()
    }

    /// Removes the conditions that were not taken.
    pub(crate) fn forget_others(&mut self) {
        for (node, _) in std::mem::take(&mut self.stored) {
            self.change(node, None);
        }
    }

    fn change(&self, node: String, bytes: Option<Vec<u8>>) {
        if let Some(shared) = &self.shared {
            shared.lock().conditions.insert(node, bytes);
            shared.changed.notify_one();
        }
    }
}

impl Pending {
    fn is_empty(&self) -> bool {
        self.values.is_empty()
            && self.floors.is_empty()
            && self.shapes.is_empty()
            && self.conditions.is_empty()
    }
}

/// Writes the remaining changes.
impl Drop for HistoryFile {
    fn drop(&mut self) {
        self.shared.lock().is_over = true;
        self.shared.changed.notify_one();
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been logged.
            drop(thread.join());
        }
    }
}

impl Shared {
    fn lock(&self) -> std::sync::MutexGuard<'_, Pending> {
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for changes. Returns `None` after the last changes.
    fn next(&self) -> Option<Pending> {
        let mut pending = self.lock();
        while pending.is_empty() && !pending.is_over {
            let waited = self.changed.wait(pending);
            pending = waited.unwrap_or_else(PoisonError::into_inner);
        }
        let is_over = pending.is_over;
        if !is_over {
            let gather = |pending: &mut Pending| !pending.is_over;
            let waited = self.changed.wait_timeout_while(pending, GATHER, gather);
            (pending, _) = waited.unwrap_or_else(PoisonError::into_inner);
        }
        let taken = std::mem::take(&mut *pending);
        pending.is_over = taken.is_over;
        let is_last = is_over && taken.is_empty();
        (!is_last).then_some(taken)
    }

    /// Writes the changes until the end. After an error the file is opened again, because the
    /// database refuses all further transactions.
    fn write_to(&self, database: Database, file: &Path) {
        let mut database = Some(database);
        let (mut lost, mut is_failing) = (0_u64, false);
        while let Some(changes) = self.next() {
            let opened = match database.take() {
                Some(database) => Ok(database),
                None => open(file),
            };
            let written = opened
                .map_err(redb::Error::from)
                .and_then(|database| write(&database, &changes).map(|()| database));
            lost = lost.saturating_add(changes.lost);
            match written {
                Ok(written) => {
                    database = Some(written);
                    if lost > 0 || is_failing {
                        warn!(
                            file = %file.display(), lost,
                            "the history is written again; these values are missing in the file"
                        );
                    }
                    (lost, is_failing) = (0, false);
                }
                Err(error) => {
                    let values = u64::try_from(changes.values.len()).unwrap_or(u64::MAX);
                    lost = lost.saturating_add(values);
                    if !is_failing {
                        warn!(
                            file = %file.display(), %error,
                            "cannot write the history; it continues in memory"
                        );
                    }
                    is_failing = true;
                    self.put_back(changes);
                }
            }
        }
    }

    /// Notes the removals, types and conditions of changes that were not written.
    fn put_back(&self, changes: Pending) {
        let mut pending = self.lock();
        if pending.is_over {
            return;
        }
        for (topic, floor) in changes.floors {
            pending.floors.entry(topic).or_insert(floor);
        }
        for (topic, shape) in changes.shapes {
            pending.shapes.entry(topic).or_insert(shape);
        }
        for (node, bytes) in changes.conditions {
            pending.conditions.entry(node).or_insert(bytes);
        }
    }
}

fn open(path: &Path) -> Result<Database, redb::DatabaseError> {
    let mut builder = Database::builder();
    builder.set_cache_size(CACHE);
    builder.create(path)
}

fn write(database: &Database, changes: &Pending) -> Result<(), redb::Error> {
    let transaction = database.begin_write()?;
    {
        let mut table = transaction.open_table(VALUES)?;
        for (topic, floor) in &changes.floors {
            let topic = key(*topic);
            table.retain_in((topic, 0)..(topic, *floor), |_, _| false)?;
        }
        for (topic, number, shown) in &changes.values {
            let floor = changes.floors.get(topic);
            if floor.is_none_or(|floor| number >= floor) {
                table.insert((key(*topic), *number), &encoded(shown)[..])?;
            }
        }
        let mut table = transaction.open_table(SHAPES)?;
        for (topic, shape) in &changes.shapes {
            table.insert(key(*topic), shape.as_str())?;
        }
        let mut table = transaction.open_table(CONDITIONS)?;
        for (node, bytes) in &changes.conditions {
            match bytes {
                Some(bytes) => drop(table.insert(node.as_str(), &bytes[..])?),
                None => drop(table.remove(node.as_str())?),
            }
        }
    }
    transaction.commit()?;
    Ok(())
}

/// The values and the conditions of a file.
type Loaded = (Vec<StoredValue>, HashMap<String, Vec<u8>>);

/// Reads the values of topics with these shapes, and removes all others. Also reads the conditions.
fn load(database: &Database, shapes: &HashMap<u64, String>) -> Result<Loaded, redb::Error> {
    let transaction = database.begin_write()?;
    {
        transaction.open_table(CONDITIONS)?;
        let mut known = transaction.open_table(SHAPES)?;
        let mut table = transaction.open_table(VALUES)?;
        let mut others = Vec::new();
        let mut same = HashSet::new();
        for row in known.iter()? {
            let (topic, shape) = row?;
            let is_same = shapes
                .get(&topic.value())
                .is_some_and(|is| is == shape.value());
            if is_same {
                same.insert(topic.value());
            } else {
                others.push(topic.value());
            }
        }
        // Values of topics without a type were received before the mapping had the topics.
        others.extend(shapes.keys().filter(|topic| !same.contains(*topic)));
        for topic in others {
            table.retain_in((topic, 0)..=(topic, u64::MAX), |_, _| false)?;
            known.remove(topic)?;
        }
        for (topic, shape) in shapes {
            known.insert(*topic, shape.as_str())?;
        }
    }
    transaction.commit()?;
    let mut stored = Vec::new();
    let transaction = database.begin_read()?;
    let table = transaction.open_table(VALUES)?;
    for row in table.iter()? {
        let (at, bytes) = row?;
        let (topic, number) = at.value();
        if let (Some(topic), Some(shown)) = (topic_of(topic), decoded(bytes.value())) {
            stored.push((topic, number, shown));
        }
    }
    let mut conditions = HashMap::new();
    let table = transaction.open_table(CONDITIONS)?;
    for row in table.iter()? {
        let (node, bytes) = row?;
        conditions.insert(node.value().to_owned(), bytes.value().to_vec());
    }
    Ok((stored, conditions))
}

fn key(topic: TopicId) -> u64 {
    let (space, namespace, identifier) = topic.triple();
    u64::from(space) << 32 | u64::from(namespace) << 16 | u64::from(identifier)
}

fn topic_of(key: u64) -> Option<TopicId> {
    let part = |shift: u32| u16::try_from((key >> shift) & 0xffff).ok();
    TopicId::new(part(32)?, part(16)?, part(0)?)
}

/// Describes the fields of a topic, to recognize values of another type.
fn shape(topic: &TopicNode) -> String {
    let fields = topic.fields.iter();
    let fields: Vec<String> = fields
        .map(|field| format!("{}:{:?}", field.name, field.shape.0))
        .collect();
    format!("{}[{}]", topic.compound, fields.join(","))
}

/// Encodes a value: the version, the status, the server timestamp, the source timestamp, and the
/// fields.
fn encoded(shown: &ShownValue) -> Vec<u8> {
    let stamp = &shown.stamp;
    let mut bytes = vec![VERSION];
    bytes.extend(stamp.status.bits().to_le_bytes());
    bytes.extend(stamp.server.ticks().to_le_bytes());
    let flags = u8::from(stamp.source.is_some()) | u8::from(shown.block.is_some()) << 1;
    bytes.push(flags);
    if let Some(source) = stamp.source {
        bytes.extend(source.time.0.to_le_bytes());
        bytes.extend(source.picoseconds.to_le_bytes());
    }
    if let Some(block) = &shown.block {
        bytes.extend(&block[..]);
    }
    bytes
}

/// Decodes a value; `None` if it is not valid.
fn decoded(bytes: &[u8]) -> Option<ShownValue> {
    let mut rest = bytes;
    if take::<1>(&mut rest)? != [VERSION] {
        return None;
    }
    let status = StatusCode::from(u32::from_le_bytes(take(&mut rest)?));
    let server = DateTime::from(i64::from_le_bytes(take(&mut rest)?));
    let [flags] = take::<1>(&mut rest)?;
    let source = match flags & 1 {
        0 => None,
        _ => Some(Timestamp {
            time: uadp::DateTime(i64::from_le_bytes(take(&mut rest)?)),
            picoseconds: u16::from_le_bytes(take(&mut rest)?),
        }),
    };
    let shown = ShownValue {
        block: (flags & 2 != 0).then(|| Bytes::copy_from_slice(rest)),
        stamp: SampleStamp {
            status,
            source,
            server,
        },
    };
    let is_valid = match &shown.block {
        None => rest.is_empty(),
        Some(_) => shown
            .fields()
            .is_some_and(|mut fields| fields.all(|field| field.is_ok())),
    };
    is_valid.then_some(shown)
}

fn take<const N: usize>(bytes: &mut &[u8]) -> Option<[u8; N]> {
    let (taken, rest) = bytes.split_first_chunk::<N>()?;
    *bytes = rest;
    Some(*taken)
}

/// Returns the size of a value that waits to be written, in bytes.
fn size(shown: &ShownValue) -> usize {
    shown.block.as_ref().map_or(0, Bytes::len) + size_of::<StoredValue>()
}

/// The values by topic and number.
const VALUES: TableDefinition<'_, (u64, u64), &[u8]> = TableDefinition::new("values");
/// The conditions by their nodes.
const CONDITIONS: TableDefinition<'_, &str, &[u8]> = TableDefinition::new("conditions");
/// The types of the topics.
const SHAPES: TableDefinition<'_, u64, &str> = TableDefinition::new("types");
const VERSION: u8 = 1;
/// Time for which changes are gathered before they are written together.
const GATHER: Duration = Duration::from_millis(500);
/// Size limit of the values that wait to be written, in bytes.
const MOST_PENDING: usize = 64 << 20;
/// Size limit of the cache of the file, in bytes.
const CACHE: usize = 8 << 20;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::{FieldNode, VariableShape};
    use uadp::BuiltinType;

    struct Scratch(PathBuf);

    impl Scratch {
        fn new(name: &str) -> Self {
            let folder = std::env::temp_dir();
            let folder = folder.join(format!("ua-history-{}-{name}", std::process::id()));
            drop(fs::remove_dir_all(&folder));
            Self(folder)
        }

        fn open(&self, topics: &[TopicNode]) -> (HistoryFile, Vec<StoredValue>) {
            HistoryFile::open(&self.0.join("below/history"), topics.iter()).unwrap()
        }
    }

    impl Drop for Scratch {
        fn drop(&mut self) {
            drop(fs::remove_dir_all(&self.0));
        }
    }

    fn node(id: u16, builtin: BuiltinType) -> TopicNode {
        let topic = TopicId::new(2, 2, id).unwrap();
        let node = NodeId::new(2, u32::from(id));
        TopicNode {
            topic,
            node: node.clone(),
            name: "value".to_owned(),
            fields: vec![FieldNode {
                node,
                name: "value".to_owned(),
                shape: VariableShape(Some((builtin, false))),
                structure: None,
            }],
            compound: false,
            meaning: Default::default(),
            sourced: false,
            targeted: false,
            historizing: true,
        }
    }

    /// A value with one field, a Double.
    fn value(number: f64) -> ShownValue {
        let mut block = vec![1, 0, 11];
        block.extend(number.to_le_bytes());
        ShownValue {
            block: Some(Bytes::from(block)),
            stamp: SampleStamp {
                status: StatusCode::Good,
                source: Some(Timestamp {
                    time: uadp::DateTime(7),
                    picoseconds: 3,
                }),
                server: DateTime::from(8),
            },
        }
    }

    fn numbers(stored: &[StoredValue], topic: TopicId) -> Vec<u64> {
        let of_topic = stored.iter().filter(|(other, ..)| *other == topic);
        of_topic.map(|(_, number, _)| *number).collect()
    }

    #[test]
    fn values_are_there_after_the_file_is_opened_again() {
        let scratch = Scratch::new("again");
        let topics = [node(1, BuiltinType::Double), node(2, BuiltinType::Double)];
        let [one, other] = [topics[0].topic, topics[1].topic];
        let (store, stored) = scratch.open(&topics);
        assert!(stored.is_empty());
        for number in 0..5 {
            store.keep(one, number, &value(1.5));
        }
        store.keep(other, 5, &ShownValue::nothing(StatusCode::BadNoData));
        store.remove_before(one, 3);
        drop(store);
        let (store, stored) = scratch.open(&topics);
        assert_eq!(numbers(&stored, one), [3, 4]);
        assert_eq!(numbers(&stored, other), [5]);
        let (_, _, first) = &stored[0];
        assert_eq!(first.block, value(1.5).block);
        assert_eq!(first.stamp.source, value(1.5).stamp.source);
        assert_eq!(first.stamp.server, DateTime::from(8));
        // Another program cannot open it at the same time.
        let second = HistoryFile::open(&scratch.0.join("below/history"), topics.iter());
        assert!(
            second
                .unwrap_err()
                .to_string()
                .contains("server.history.file")
        );
        drop(store);
    }

    #[test]
    fn values_of_removed_topics_and_of_other_types_are_removed() {
        let scratch = Scratch::new("types");
        let topics = [node(1, BuiltinType::Double), node(2, BuiltinType::Double)];
        let [one, other] = [topics[0].topic, topics[1].topic];
        let (store, _) = scratch.open(&topics);
        store.keep(one, 0, &value(1.0));
        store.keep(other, 1, &value(1.0));
        drop(store);
        let (store, stored) = scratch.open(&[node(1, BuiltinType::Int32)]);
        assert!(stored.is_empty());
        drop(store);
        let (_store, stored) = scratch.open(&topics);
        assert!(stored.is_empty(), "they do not return");
    }

    #[test]
    fn values_of_topics_that_were_added_later_need_a_type() {
        let scratch = Scratch::new("later");
        let topics = [node(1, BuiltinType::Double), node(2, BuiltinType::Double)];
        let [one, other] = [topics[0].topic, topics[1].topic];
        let (store, _) = scratch.open(&[]);
        store.describe(&topics[0]);
        store.keep(one, 0, &value(1.0));
        store.keep(other, 1, &value(1.0));
        drop(store);
        let (_store, stored) = scratch.open(&topics);
        assert_eq!(numbers(&stored, one), [0]);
        assert!(numbers(&stored, other).is_empty());
    }

    #[test]
    fn conditions_are_there_again_and_those_without_an_alarm_are_removed() {
        let scratch = Scratch::new("conditions");
        let [one, other] = ["one", "other"].map(|name| NodeId::new(1, name));
        let (mut store, _) = scratch.open(&[]);
        let conditions = store.take_conditions();
        conditions.keep(&one, vec![1]);
        conditions.keep(&one, vec![2]);
        conditions.keep(&other, vec![3]);
        drop(store);
        let (mut store, _) = scratch.open(&[]);
        let mut conditions = store.take_conditions();
        assert_eq!(conditions.take(&one), Some(vec![2]));
        conditions.forget_others();
        drop(store);
        let (mut store, _) = scratch.open(&[]);
        let mut conditions = store.take_conditions();
        assert_eq!(conditions.take(&other), None);
        assert_eq!(conditions.take(&one), Some(vec![2]));
    }

    #[test]
    fn a_file_that_is_no_history_is_refused_and_stays() {
        let scratch = Scratch::new("foreign");
        fs::create_dir_all(&scratch.0).unwrap();
        let path = scratch.0.join("notes.txt");
        fs::write(&path, "a text".repeat(1_000)).unwrap();
        let refused = HistoryFile::open(&path, std::iter::empty());
        assert!(refused.is_err());
        assert_eq!(fs::read(&path).unwrap().len(), 6_000);
    }

    #[test]
    fn damaged_values_are_left_out() {
        let good = encoded(&value(2.0));
        assert!(decoded(&good).is_some());
        for end in 0..good.len() {
            assert!(decoded(&good[..end]).is_none(), "{end}");
        }
        let nothing = encoded(&ShownValue::nothing(StatusCode::BadNoData));
        assert!(decoded(&nothing).is_some());
        assert!(decoded(&[nothing, vec![0]].concat()).is_none());
    }
}

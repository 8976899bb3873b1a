//! Reads the metadata of RawData messages from a file.

use std::path::Path;

use serde::Deserialize;
use serde_json::{Map, Value};

use crate::arguments::RawReading;
use crate::exit::CommandFailure;
use crate::raw_data::RawDataLayout;
use crate::shape::{FieldMetaData, PublisherIdJson};
use crate::{json_file, selector};

/// The metadata of a file. The first entry that matches a message is used.
#[derive(Debug, Default)]
pub(crate) struct MetaDataFile {
    entries: Vec<MetadataEntry>,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct MetadataEntry {
    publisher_id: Option<selector::PublisherSelector>,
    writer_group_id: Option<u16>,
    data_set_writer_id: Option<u16>,
    meta_data: Vec<FieldMetaData>,
}

/// The writer of a DataSetMessage.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct WriterKey<'a> {
    pub(crate) publisher_id: Option<&'a PublisherIdJson>,
    pub(crate) writer_group_id: Option<u16>,
    pub(crate) data_set_writer_id: Option<u16>,
}

impl MetaDataFile {
    /// Reads entries, or a list of fields that applies to all messages.
    pub(crate) fn read(path: &Path, reading: RawReading) -> Result<Self, CommandFailure> {
        let text = json_file::read(path)?;
        let read = if is_list_of_fields(&text) {
            serde_json::from_str(&text).map(|meta_data| {
                vec![MetadataEntry {
                    publisher_id: None,
                    writer_group_id: None,
                    data_set_writer_id: None,
                    meta_data,
                }]
            })
        } else {
            json_file::one_or_many(&text)
        };
        let name = path.display().to_string();
        let entries = read.map_err(|error| json_file::explain(&name, &error))?;
        for (entry, at) in entries.iter().zip(0..) {
            RawDataLayout::new(&entry.meta_data, reading)
                .map_err(|wrong| CommandFailure::Data(format!("{name}: entry {at}{wrong}")))?;
        }
        Ok(Self { entries })
    }

    /// Returns the fields of a message, if an entry matches.
    pub(crate) fn find(&self, writer: WriterKey<'_>) -> Option<&[FieldMetaData]> {
        let fits = |entry: &&MetadataEntry| {
            selector::publisher_fits(entry.publisher_id.as_ref(), writer.publisher_id)
                && selector::number_fits(entry.writer_group_id, writer.writer_group_id)
                && selector::number_fits(entry.data_set_writer_id, writer.data_set_writer_id)
        };
        self.entries
            .iter()
            .find(fits)
            .map(|entry| entry.meta_data.as_slice())
    }
}

fn is_list_of_fields(text: &str) -> bool {
    let list: Option<Vec<Map<String, Value>>> = serde_json::from_str(text).ok();
    list.is_some_and(|list| list.iter().all(|entry| entry.contains_key("builtInType")))
}

//! Decoding allocates nothing, independent of the encoded counts.

use allocation_counter::measure;
use uadp::DecodeError;
use uadp::discovery::{AnnouncedContent, Announcement, DataSetMetaDataType, Probe};

use crate::discovery::asyncua::bodies;

#[test]
fn reading_allocates_nothing() {
    let bodies = bodies();
    let mut fields = 0;
    let allocations = measure(|| {
        for body in &bodies {
            fields += count_fields(&Announcement::decode_body(body).unwrap().announced);
        }
        let probe = Probe::decode_body(&[1, 2, 2, 0, 0, 0, 1, 0, 2, 0]).unwrap();
        if let Probe::DataSetMetaData(ids) = probe {
            fields += ids.iter().count();
        }
    });
    // A field in each of five DataSetMetaData, and two ids.
    assert_eq!(fields, 5 + 2);
    assert_eq!(allocations.count_total, 0);
}

#[test]
fn a_count_that_cannot_be_is_refused_before_anything_is_read() {
    let huge = 0x7FFF_FFFF_u32;
    for (name, head) in [
        ("Endpoints", &[1, 0, 0][..]),
        ("DataTypeSchemaHeader Namespaces", &[2, 0, 0, 1, 0]),
        ("DataSetWriterIds", &[3, 0, 0]),
        ("PubSubConnections", &[4, 0, 0]),
        ("ActionResponder", &[6, 0, 0]),
        ("ActionMetaData ActionTargets", &[7, 0, 0, 1, 0]),
    ] {
        let body = [head, &huge.to_le_bytes(), &[0; 1000]].concat();
        let mut found = None;
        let allocations = measure(|| found = Announcement::decode_body(&body).err());
        let error = DecodeError::Limit {
            field: name,
            value: huge,
        };
        assert_eq!(found, Some(error));
        assert_eq!(allocations.count_total, 0);
    }
    let probe = [&[1, 2][..], &huge.to_le_bytes(), &[0; 1000]].concat();
    let mut found = None;
    let allocations = measure(|| found = Probe::decode_body(&probe).err());
    let error = DecodeError::Limit {
        field: "DataSetWriterIds",
        value: huge,
    };
    assert_eq!(found, Some(error));
    assert_eq!(allocations.count_total, 0);
}

#[test]
fn hostile_lengths_anywhere_are_refused_or_harmless_and_allocate_nothing() {
    for mut body in bodies() {
        for at in 0..body.len() - 4 {
            for hostile in [0x7FFF_FFFF_u32, 0xFFFF_FFFE, 0x0001_0000, 0xFFFF_FFFF, 0] {
                let kept: [u8; 4] = body[at..at + 4].try_into().unwrap();
                body[at..at + 4].copy_from_slice(&hostile.to_le_bytes());
                let mut fields = 0;
                let allocations = measure(|| {
                    if let Ok(found) = Announcement::decode_body(&body) {
                        fields = count_fields(&found.announced);
                    }
                });
                assert_eq!(allocations.count_total, 0, "at {at}");
                assert!(fields <= body.len());
                body[at..at + 4].copy_from_slice(&kept);
            }
        }
    }
}

/// Returns the number of fields of all DataSetMetaData.
fn count_fields(announced: &AnnouncedContent<'_>) -> usize {
    let meta_data = |meta_data: &DataSetMetaDataType<'_>| meta_data.fields.iter().count();
    match announced {
        AnnouncedContent::DataSetMetaData { meta_data: it, .. } => meta_data(it),
        AnnouncedContent::ActionMetaData(action) => {
            meta_data(&action.request) + meta_data(&action.response)
        }
        AnnouncedContent::PubSubConnections(connections)
        | AnnouncedContent::ActionResponder(connections) => {
            let groups = connections.iter().flat_map(|it| it.reader_groups);
            let readers = groups.flat_map(|group| group.data_set_readers);
            readers.map(|it| meta_data(&it.data_set_meta_data)).sum()
        }
        AnnouncedContent::PublisherEndpoints { .. }
        | AnnouncedContent::DataSetWriterConfiguration { .. }
        | AnnouncedContent::PubSubConnection { .. }
        | AnnouncedContent::ApplicationDescription { .. }
        | AnnouncedContent::ApplicationStatus { .. } => 0,
    }
}

//! Fuzzes probes and announcements with arbitrary bytes.

use uadp::discovery::{AnnouncedContent, Announcement, Probe};

/// Decodes a probe or an announcement. Its encoding must decode and encode to the same bytes.
pub fn discovery(body: &[u8]) {
    if let Ok(probe) = Probe::decode_body(body) {
        let mut written = Vec::new();
        probe.encode_body(&mut written).expect("what was read fits");
        let again = Probe::decode_body(&written).expect("what was written can be read");
        let mut twice = Vec::new();
        again.encode_body(&mut twice).expect("it fitted before");
        assert_eq!(written, twice, "writing is not canonical");
    }
    let Ok(announcement) = Announcement::decode_body(body) else {
        return;
    };
    if let AnnouncedContent::DataSetMetaData { meta_data, .. } = &announcement.announced {
        for field in meta_data.fields.iter() {
            let _ = (field.builtin_type(), field.array_dimensions.iter().count());
            let _ = meta_data.schema.structure(field.data_type);
        }
        for structure in meta_data.schema.structure_data_types.iter() {
            let _ = format!("{structure:?}");
        }
    }
    let mut written = Vec::new();
    announcement
        .encode_body(&mut written)
        .expect("what was read fits");
    let again = Announcement::decode_body(&written).expect("what was written can be read");
    let mut twice = Vec::new();
    again.encode_body(&mut twice).expect("it fitted before");
    assert_eq!(written, twice, "writing is not canonical");
}

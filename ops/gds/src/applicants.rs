//! Applications without a trusted certificate that request registration. They are registered when
//! their certificate is issued.

use std::collections::VecDeque;

use opcua::types::NodeId;
use trust::Fingerprint;

use crate::records::GdsRecord;

/// The applicants, oldest first. The oldest are dropped if there are too many; they can register
/// again.
#[derive(Debug, Default)]
pub(crate) struct Applicants {
    all: VecDeque<(NodeId, GdsRecord)>,
}

impl Applicants {
    /// Adds an application and returns its provisional ApplicationId. The id depends on the key, so
    /// that an applicant cannot change the record of another applicant.
    pub(crate) fn put(&mut self, record: GdsRecord, key: Fingerprint) -> NodeId {
        let of = Fingerprint::of(format!("{key} {}", record.uri).as_bytes());
        let id = NodeId::new(OWN, format!("applicant-{of}"));
        self.all.retain(|(known, _)| *known != id);
        if self.all.len() >= MOST {
            self.all.pop_front();
        }
        self.all.push_back((id.clone(), record));
        id
    }

    /// Returns the application of a provisional ApplicationId.
    pub(crate) fn get(&self, id: &NodeId) -> Option<&GdsRecord> {
        let found = self.all.iter().find(|(known, _)| known == id);
        found.map(|(_, record)| record)
    }
}

/// The namespace of the server itself.
pub(crate) const OWN: u16 = 1;
const MOST: usize = 200;

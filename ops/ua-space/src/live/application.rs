//! The application descriptions that programs announce.

use uadp::discovery::{ApplicationDescription, WireArray};

/// The announced description of a program.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct AnnouncedProgram {
    pub(crate) uri: String,
    pub(crate) product_uri: String,
    pub(crate) name: String,
    /// The DiscoveryUrls of its server; empty if the program has no server.
    pub(crate) urls: Vec<String>,
    pub(crate) capabilities: Vec<String>,
}

impl AnnouncedProgram {
    /// Reads a description; `None` if texts are too long or too many, or the ApplicationUri is
    /// missing.
    pub(super) fn read(
        description: &ApplicationDescription<'_>,
        capabilities: WireArray<'_, Option<&str>>,
    ) -> Option<Self> {
        let text = |text: Option<&str>| {
            let text = text.unwrap_or_default();
            (text.len() <= LONGEST).then(|| text.to_owned())
        };
        let texts = |list: WireArray<'_, Option<&str>>| -> Option<Vec<String>> {
            list.iter().take(MOST_TEXTS).map(text).collect()
        };
        let uri = text(description.application_uri)?;
        (!uri.is_empty()).then_some(())?;
        Some(Self {
            uri,
            product_uri: text(description.product_uri)?,
            name: text(description.application_name.text)?,
            urls: texts(description.discovery_urls)?,
            capabilities: texts(capabilities)?,
        })
    }
}

const LONGEST: usize = 512;
const MOST_TEXTS: usize = 16;

//! What programs of a group say they are.

use uadp::discovery::{ApplicationDescription, List};

/// A program, in its own words.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Application {
    pub(crate) uri: String,
    pub(crate) product_uri: String,
    pub(crate) name: String,
    /// Where its server is; none of a program without one.
    pub(crate) urls: Vec<String>,
    pub(crate) capabilities: Vec<String>,
}

impl Application {
    /// `None` where the words are too long, too many, or do not say who it is.
    pub(super) fn read(
        description: &ApplicationDescription<'_>,
        capabilities: List<'_, Option<&str>>,
    ) -> Option<Self> {
        let text = |text: Option<&str>| {
            let text = text.unwrap_or_default();
            (text.len() <= LONGEST).then(|| text.to_owned())
        };
        let texts = |list: List<'_, Option<&str>>| -> Option<Vec<String>> {
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

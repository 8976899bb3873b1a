//! The capabilities of a server in the core namespace (OPC 10000-5, 6.3.2): its profiles and the
//! limits that the library does not report.

use opcua::server::Limits;
use opcua::types::{UAString, VariableId, Variant};

use super::supplement::CoreValue;

/// The features of a server beyond those that every server has.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Facets {
    /// Endpoints with a security policy other than None.
    pub is_secured: bool,
    /// Histories of values.
    pub has_history: bool,
    /// Alarms and conditions.
    pub has_alarms: bool,
}

/// Returns the profiles of a server, by its limits and features.
#[must_use]
pub fn profiles(limits: &Limits, facets: Facets) -> Vec<String> {
    let has_sessions = limits.max_sessions >= SESSIONS_OF_STANDARD;
    let mut names = vec![match facets.is_secured {
        true if has_sessions => "StandardUA2017",
        true => "EmbeddedUA2017",
        false => "MicroEmbeddedDevice2017",
    }];
    names.extend([
        "EnhancedDataChangeSubscription2017",
        "StandardEventSubscription",
        "Methods",
        "ComplexTypes2017",
    ]);
    if facets.has_history {
        names.extend([
            "HistoricalRawData",
            "AggregateHistorical",
            "AggregateSubscription",
        ]);
    }
    if facets.has_alarms {
        names.extend([
            "ACBaseCondition",
            "ACRefresh2",
            "ACAddressSpaceInstance",
            "ACEnable",
            "ACAlarm",
            "ACAckAlarm",
            "ACExclusiveAlarming",
            "ACNon-ExclusiveAlarming",
            "BaseHistoricalEvent",
        ]);
    }
    let uri = |name| format!("http://opcfoundation.org/UA-Profile/Server/{name}");
    names.into_iter().map(uri).collect()
}

/// Returns the profiles, and the limits that clients can read in addition to the limits that the
/// library reports.
#[must_use]
pub fn capabilities(limits: &Limits, facets: Facets) -> Vec<(VariableId, CoreValue)> {
    let count = |number: usize| {
        let number = u32::try_from(number).unwrap_or(u32::MAX);
        CoreValue::Fixed(Variant::UInt32(number))
    };
    let (sessions, each) = (limits.max_sessions, &limits.subscriptions);
    let subscriptions = sessions.saturating_mul(each.max_subscriptions_per_session);
    let items = subscriptions.saturating_mul(each.max_monitored_items_per_sub);
    let locales = vec![UAString::from("en")];
    let profiles = profiles(limits, facets);
    let profiles: Vec<UAString> = profiles.into_iter().map(UAString::from).collect();
    vec![
        (
            VariableId::Server_ServerCapabilities_ServerProfileArray,
            Variant::from(profiles).into(),
        ),
        (
            VariableId::Server_ServerCapabilities_LocaleIdArray,
            Variant::from(locales).into(),
        ),
        (
            VariableId::Server_ServerCapabilities_MaxSessions,
            count(sessions),
        ),
        (
            VariableId::Server_ServerCapabilities_MaxSubscriptions,
            count(subscriptions),
        ),
        (
            VariableId::Server_ServerCapabilities_MaxSubscriptionsPerSession,
            count(each.max_subscriptions_per_session),
        ),
        (
            VariableId::Server_ServerCapabilities_MaxMonitoredItems,
            count(items),
        ),
        (
            VariableId::Server_ServerCapabilities_MaxMonitoredItemsPerSubscription,
            count(each.max_monitored_items_per_sub),
        ),
        (
            VariableId::Server_ServerCapabilities_MaxMonitoredItemsQueueSize,
            count(each.max_monitored_item_queue_size),
        ),
        // RedundancySupport None, unless a redundant server gives another value before.
        (
            VariableId::Server_ServerRedundancy_RedundancySupport,
            Variant::from(0_i32).into(),
        ),
    ]
}

/// Number of parallel sessions of the profile Standard 2017 UA Server.
const SESSIONS_OF_STANDARD: usize = 50;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::limits::{self, ClientLimits};

    #[test]
    fn the_profile_is_what_security_and_sessions_permit() {
        let first = |sessions, is_secured| {
            let limits = limits::server(ClientLimits::of(sessions));
            let facets = Facets {
                is_secured,
                ..Facets::default()
            };
            profiles(&limits, facets).remove(0)
        };
        assert!(first(50, true).ends_with("/StandardUA2017"));
        assert!(first(49, true).ends_with("/EmbeddedUA2017"));
        assert!(first(50, false).ends_with("/MicroEmbeddedDevice2017"));
    }

    #[test]
    fn facets_are_listed_for_the_features_of_the_server() {
        let limits = limits::server(ClientLimits::default());
        let has = |facets, name: &str| profiles(&limits, facets).iter().any(|p| p.ends_with(name));
        let history = Facets {
            has_history: true,
            ..Facets::default()
        };
        assert!(has(history, "/HistoricalRawData"));
        assert!(!has(history, "/ACAlarm"));
        assert!(!has(Facets::default(), "/HistoricalRawData"));
    }

    #[test]
    fn the_page_of_conformance_lists_the_profiles() {
        let facets = |is_secured| Facets {
            is_secured,
            has_history: true,
            has_alarms: true,
        };
        let listed = |sessions, is_secured| {
            let limits = limits::server(ClientLimits::of(sessions));
            profiles(&limits, facets(is_secured))
        };
        // The profile of the server, and then its facets.
        let mut all = vec![
            listed(50, true).remove(0),
            listed(49, true).remove(0),
            listed(50, false).remove(0),
        ];
        all.extend(listed(50, true).into_iter().skip(1));
        let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/conformance.md");
        let page = std::fs::read_to_string(page).unwrap();
        let (_, table) = page.split_once("| URI | profile or facet |").unwrap();
        let (table, _) = table.split_once("\n\n").unwrap();
        let named = table.lines().filter_map(|line| {
            let (name, _) = line.strip_prefix("| `")?.split_once('`')?;
            Some(format!("http://opcfoundation.org/UA-Profile/Server/{name}"))
        });
        assert_eq!(named.collect::<Vec<_>>(), all);
    }
}

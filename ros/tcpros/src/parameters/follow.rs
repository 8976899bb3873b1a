//! The parameters of this node at the master: parameters from the command line, and subscribed
//! parameters.
//!
//! The registrar calls [`settle`] whenever something may have changed. A master that starts late or
//! restarts is thus handled like a new subscription.

use std::collections::BTreeMap;
use std::sync::Mutex;

use log_limit::Throttle;
use tokio::sync::watch;

use crate::clock;
use crate::events;
use crate::master::MasterError;
use crate::node::Inner;
use crate::outbox::lock;
use crate::parameters::{ParamValue, exists, known, read, write};
use crate::rpc::RpcError;

/// State of a subscribed parameter.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum ParameterState {
    /// The parameter was not read from the master yet.
    Nothing,
    /// The last value from the master, or `None` if the parameter is not set.
    Value(Option<ParamValue>),
}

/// The desired state of the node's parameters at the master.
#[derive(Debug)]
pub(crate) struct Params {
    table: Mutex<Table>,
    /// The parameter that selects the clock.
    use_sim_time: String,
}

#[derive(Debug)]
struct Table {
    given: Vec<Given>,
    followed: BTreeMap<String, Followed>,
    closed: bool,
}

/// A parameter given on the command line.
#[derive(Debug)]
struct Given {
    name: String,
    value: ParamValue,
    /// Whether the current master has the parameter.
    told: bool,
    /// Whether any master has had the parameter.
    ever: bool,
}

#[derive(Debug)]
struct Followed {
    holders: usize,
    /// Whether a subscription was requested, with or without a reply: a call that timed out may
    /// still have been executed by the master.
    told: bool,
    subscribed: bool,
    /// Whether the parameter has changed after its last read.
    stale: bool,
    heard: watch::Sender<ParameterState>,
}

/// A call to make.
#[derive(Debug)]
enum Work {
    Set {
        name: String,
        value: ParamValue,
        /// Whether a value that is set in the meantime is kept.
        unless_set: bool,
    },
    Subscribe(String),
    Read(String),
    Unsubscribe(String),
}

impl Params {
    /// Creates the state with the parameters in `given`, by full name. `use_sim_time` is subscribed
    /// to from the start.
    pub(crate) fn new(given: Vec<(String, ParamValue)>, use_sim_time: String) -> Self {
        let given = given.into_iter().map(|(name, value)| Given {
            name,
            value,
            told: false,
            ever: false,
        });
        let table = Table {
            given: given.collect(),
            followed: BTreeMap::new(),
            closed: false,
        };
        let params = Self {
            table: Mutex::new(table),
            use_sim_time,
        };
        // The node holds this subscription for its whole life.
        drop(params.hold(&params.use_sim_time));
        params
    }

    /// Subscribes to a parameter until it is released as often as it was held.
    pub(crate) fn hold(&self, name: &str) -> watch::Receiver<ParameterState> {
        let mut table = lock(&self.table);
        if table.closed {
            return watch::Sender::new(ParameterState::Nothing).subscribe();
        }
        let entry = table
            .followed
            .entry(name.to_owned())
            .or_insert_with(|| Followed {
                holders: 0,
                told: false,
                subscribed: false,
                stale: false,
                heard: watch::Sender::new(ParameterState::Nothing),
            });
        entry.holders += 1;
        let mut heard = entry.heard.subscribe();
        // A value received for another holder is new to this holder.
        heard.mark_changed();
        heard
    }

    pub(crate) fn release(&self, name: &str) {
        if let Some(entry) = lock(&self.table).followed.get_mut(name) {
            entry.holders = entry.holders.saturating_sub(1);
        }
    }

    /// Marks the subscriptions that have to be read again because the parameter or namespace `name`
    /// changed.
    pub(crate) fn touch(&self, name: &str) {
        for (followed, entry) in &mut lock(&self.table).followed {
            if covers(followed, name) || covers(name, followed) {
                entry.stale = true;
            }
        }
    }

    /// Records that the master has lost all state of this node.
    pub(crate) fn forget(&self) {
        let mut table = lock(&self.table);
        for given in &mut table.given {
            given.told = false;
        }
        for entry in table.followed.values_mut() {
            entry.subscribed = false;
        }
    }

    /// Returns whether the master should know this node because of a subscribed parameter.
    pub(crate) fn any_subscribed(&self) -> bool {
        let table = lock(&self.table);
        table.followed.values().any(|entry| entry.subscribed)
    }

    /// Ends all subscriptions: [`settle`] unsubscribes them at the master, and they receive no more
    /// values.
    pub(crate) fn close(&self) {
        let mut table = lock(&self.table);
        table.closed = true;
        for entry in table.followed.values_mut() {
            entry.holders = 0;
            entry.heard = watch::Sender::new(ParameterState::Nothing);
        }
    }

    /// Removes the subscriptions that could not be unsubscribed, and returns their names.
    pub(crate) fn abandon(&self) -> Vec<String> {
        let followed = std::mem::take(&mut lock(&self.table).followed);
        followed.into_keys().collect()
    }

    #[cfg(test)]
    pub(crate) fn given(&self) -> Vec<(String, ParamValue)> {
        let table = lock(&self.table);
        let given = table.given.iter();
        given.map(|g| (g.name.clone(), g.value.clone())).collect()
    }

    /// Returns whether all subscriptions are unsubscribed.
    pub(crate) fn is_empty(&self) -> bool {
        lock(&self.table).followed.is_empty()
    }

    fn work(&self) -> Vec<Work> {
        let mut table = lock(&self.table);
        let mut work = Vec::new();
        if !table.closed {
            work.extend(table.given.iter().filter(|g| !g.told).map(|g| Work::Set {
                name: g.name.clone(),
                value: g.value.clone(),
                unless_set: g.ever,
            }));
        }
        table.followed.retain(|_, e| e.holders > 0 || e.told);
        for (name, entry) in &mut table.followed {
            if entry.holders == 0 {
                work.push(Work::Unsubscribe(name.clone()));
            } else if !entry.subscribed {
                entry.stale = false;
                work.push(Work::Subscribe(name.clone()));
            } else if std::mem::take(&mut entry.stale) {
                work.push(Work::Read(name.clone()));
            }
        }
        work
    }

    fn has_set(&self, name: &str) {
        for given in &mut lock(&self.table).given {
            if given.name == name {
                (given.told, given.ever) = (true, true);
            }
        }
    }

    fn asks_for(&self, name: &str) {
        if let Some(entry) = lock(&self.table).followed.get_mut(name) {
            entry.told = true;
        }
    }

    fn has_read(&self, name: &str, value: Option<ParamValue>) {
        if let Some(entry) = lock(&self.table).followed.get_mut(name) {
            entry.subscribed = true;
            let now = ParameterState::Value(value);
            entry.heard.send_if_modified(|heard| {
                let news = *heard != now;
                *heard = now;
                news
            });
        }
    }

    fn has_unsubscribed(&self, name: &str) {
        let mut table = lock(&self.table);
        if let Some(entry) = table.followed.get_mut(name) {
            (entry.subscribed, entry.told) = (false, false);
            if entry.holders == 0 {
                table.followed.remove(name);
            }
        }
    }

    fn failed(&self, work: &Work) {
        if let Work::Read(name) = work
            && let Some(entry) = lock(&self.table).followed.get_mut(name)
        {
            entry.stale = true;
        }
    }
}

/// Updates the master and the subscriptions. Fails only if the master does not reply; a parameter
/// that is refused or cannot be read is retried the next time.
pub(crate) async fn settle(node: &Inner, refusals: &mut Throttle) -> Result<(), MasterError> {
    let params = &node.params;
    for work in params.work() {
        if !node.may_register() && !matches!(work, Work::Unsubscribe(_)) {
            // The name, and with it the private parameters, may belong to another node.
            params.failed(&work);
            continue;
        }
        match perform(node, &work).await {
            Ok(()) => {}
            Err(error) if is_unreachable(&error) => {
                params.failed(&work);
                return Err(error);
            }
            Err(error) => {
                params.failed(&work);
                if let Work::Unsubscribe(name) = &work {
                    // A master that does not know the subscription has nothing to remove.
                    params.has_unsubscribed(name);
                } else if refusals.admit(clock::now()).is_some() {
                    events::parameter_failed(work.name(), &error);
                }
            }
        }
    }
    Ok(())
}

async fn perform(node: &Inner, work: &Work) -> Result<(), MasterError> {
    match work {
        Work::Set {
            name,
            value,
            unless_set,
        } => {
            if !unless_set || !exists(node, name).await? {
                write(node, name, value.clone()).await?;
            }
            node.params.has_set(name);
        }
        Work::Subscribe(name) => {
            node.params.asks_for(name);
            let params = vec![node.uri.as_str().into(), name.as_str().into()];
            let value = known(
                "subscribeParam",
                node.master.call("subscribeParam", params).await?,
            )?;
            // An empty map is an empty namespace, or a parameter that is not set.
            let value = if value.as_map().is_some_and(BTreeMap::is_empty) {
                read(&node.master, name).await?
            } else {
                Some(value)
            };
            heard(node, name, value);
        }
        Work::Read(name) => {
            let value = read(&node.master, name).await?;
            heard(node, name, value);
        }
        Work::Unsubscribe(name) => {
            let params = vec![node.uri.as_str().into(), name.as_str().into()];
            node.master.call("unsubscribeParam", params).await?;
            node.params.has_unsubscribed(name);
        }
    }
    Ok(())
}

impl Work {
    fn name(&self) -> &str {
        match self {
            Self::Set { name, .. }
            | Self::Subscribe(name)
            | Self::Read(name)
            | Self::Unsubscribe(name) => name,
        }
    }
}

fn heard(node: &Inner, name: &str, value: Option<ParamValue>) {
    if name == node.params.use_sim_time {
        node.simulate(value.as_ref().and_then(ParamValue::as_bool) == Some(true));
    }
    node.params.has_read(name, value);
}

/// Returns whether the first name equals the second name or is its namespace.
fn covers(namespace: &str, name: &str) -> bool {
    let rest = name.strip_prefix(namespace.trim_end_matches('/'));
    rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

/// Returns whether the master is unreachable. A value that cannot be read does not mean this.
const fn is_unreachable(error: &MasterError) -> bool {
    match error {
        MasterError::Refused { .. } | MasterError::Shape(_) => false,
        MasterError::Rpc(error) => match error {
            RpcError::Connect(_)
            | RpcError::Timeout(_)
            | RpcError::Http(_)
            | RpcError::Status(_)
            | RpcError::Uri => true,
            RpcError::Body(_) | RpcError::Xml(_) | RpcError::Fault(_) => false,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_namespace_covers_what_it_holds_and_not_what_begins_alike() {
        assert!(covers("/", "/a"));
        assert!(covers("/a", "/a") && covers("/a", "/a/b"));
        assert!(!covers("/a", "/ab") && !covers("/a/b", "/a"));
    }

    #[test]
    fn a_change_above_or_below_makes_a_followed_parameter_stale() {
        let params = Params::new(Vec::new(), "/use_sim_time".to_owned());
        let mut heard = params.hold("/a/b");
        params.has_read("/a/b", None);
        assert!(heard.has_changed().unwrap());
        heard.mark_unchanged();
        for (changed, stale) in [
            ("/a", true),
            ("/a/b/c", true),
            ("/a/bc", false),
            ("/x", false),
        ] {
            params.touch(changed);
            let reads = |w: &Work| matches!(w, Work::Read(name) if name == "/a/b");
            assert_eq!(params.work().iter().any(reads), stale, "{changed}");
        }
    }

    #[test]
    fn what_a_master_was_asked_for_is_withdrawn_though_it_did_not_answer() {
        let params = Params::new(Vec::new(), "/use_sim_time".to_owned());
        let withdraws = |name: &str| {
            let mut work = params.work().into_iter();
            work.any(|w| matches!(w, Work::Unsubscribe(of) if of == name))
        };
        for name in ["/asked", "/unasked"] {
            drop(params.hold(name));
        }
        params.asks_for("/asked");
        // The master was unreachable in the meantime, and may be the same.
        params.forget();
        assert!(!withdraws("/asked"));
        params.release("/asked");
        params.release("/unasked");
        assert!(withdraws("/asked") && !withdraws("/unasked"));
        params.has_unsubscribed("/asked");
        assert!(!withdraws("/asked"));
    }

    #[test]
    fn what_is_read_anew_and_equal_is_no_news() {
        let params = Params::new(Vec::new(), "/use_sim_time".to_owned());
        let mut heard = params.hold("/a");
        params.has_read("/a", Some(1.into()));
        heard.mark_unchanged();
        params.has_read("/a", Some(1.into()));
        assert!(!heard.has_changed().unwrap());
        params.has_read("/a", Some(2.into()));
        assert!(heard.has_changed().unwrap());
    }
}

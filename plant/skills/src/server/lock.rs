//! Locking of a component (OPC 10000-100, 7): a session holds the lease of its skills without
//! running them.

use std::future::Future;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use plant_opcua::server::{
    IdRange, Instance, InstanceError, InstanceSpec, MethodRequest, OpcUaServer, method,
};
use plant_opcua::types::{NodeId, QualifiedName, StatusCode, Variant};
use tokio::sync::watch;
use tokio::time::{Instant, sleep_until};

use crate::authority::{Authority, SkillOwner};
use crate::lock::lock;
pub(super) use crate::model::DEVICES as NAMESPACE;
use crate::refusal::SkillRefusal;

/// The part of the DI NodeSet that defines locking, for components that need no other part of it.
pub(super) const NODESET: &str = include_str!("locking.xml");

/// Returns whether a NodeSet file defines the complete namespace. The loader reports files that
/// cannot be read.
pub(super) fn has_di(file: &Path) -> bool {
    let text = std::fs::read_to_string(file).unwrap_or_default();
    let model = format!("<Model ModelUri=\"{NAMESPACE}\"");
    text.contains(&model)
}

/// The object Lock of a component.
#[derive(Clone)]
pub(super) struct Lock {
    server: OpcUaServer,
    authority: Authority,
    object: Instance,
    /// Serializes changes of the lock with the values that show them.
    shows: Arc<Mutex<()>>,
    changed: watch::Sender<()>,
}

impl Lock {
    /// Creates the object below the component. The returned future ends locks that are not renewed
    /// and locks of sessions that lost the lease.
    pub(super) fn serve(
        server: &OpcUaServer,
        authority: &Authority,
        component: &NodeId,
        ids: &mut IdRange,
    ) -> Result<impl Future<Output = ()> + use<>, InstanceError> {
        let none = || InstanceError::NoType(NodeId::null());
        let of_type = server
            .find_type(NAMESPACE, "LockingServicesType")
            .ok_or_else(none)?;
        let name = QualifiedName::new(server.namespace(NAMESPACE).unwrap_or_default(), "Lock");
        let spec = InstanceSpec::new(of_type, ids.next(), name, component.clone());
        let object = server.instantiate(&spec, &mut |_| ids.next())?;
        let lock = Self {
            server: server.clone(),
            authority: authority.clone(),
            object,
            shows: Arc::default(),
            changed: watch::channel(()).0,
        };
        lock.show(None);
        for (name, call) in [
            (
                "InitLock",
                Self::init as fn(&Self, &MethodRequest) -> Answer,
            ),
            ("RenewLock", Self::renew),
            ("ExitLock", Self::exit),
            ("BreakLock", Self::break_lock),
        ] {
            let Some(node) = lock.object.node(name).cloned() else {
                continue;
            };
            let own = lock.clone();
            let handler = method(move |request| match call(&own, &request) {
                Ok(status) => Ok(vec![status.into()]),
                Err(status) => Err(status.into()),
            });
            server.on_call(&lock.object.node_id, &node, handler);
        }
        Ok(lock.watch())
    }

    fn init(&self, request: &MethodRequest) -> Answer {
        let _shows = lock(&self.shows);
        if self.lock_for(request).is_err() {
            return Ok(ALREADY_LOCKED);
        }
        let context = match request.arguments.first() {
            Some(Variant::String(context)) => context.as_ref().to_owned(),
            _ => String::new(),
        };
        // Without a context, the lock is shown with the ApplicationUri of the client.
        let client = if context.is_empty() {
            request.caller.application_uri.clone()
        } else {
            context
        };
        self.show(Some((&client, &request.caller.user)));
        Ok(DONE)
    }

    fn renew(&self, request: &MethodRequest) -> Answer {
        if !self.authority.renew_lock(&owner_of(request), LONGEST_LOCK) {
            return Ok(NOT_LOCKED);
        }
        self.changed.send_replace(());
        Ok(DONE)
    }

    fn exit(&self, request: &MethodRequest) -> Answer {
        if !self.is_held_by(request) {
            return Ok(NOT_LOCKED);
        }
        self.authority.release(&owner_of(request));
        self.show_end();
        Ok(DONE)
    }

    /// Always refused: the method is for administrators, and a component has no administrators.
    fn break_lock(&self, _request: &MethodRequest) -> Answer {
        Err(StatusCode::BadUserAccessDenied)
    }

    fn is_held_by(&self, request: &MethodRequest) -> bool {
        self.authority.is_locked_by(&owner_of(request))
    }

    fn lock_for(&self, request: &MethodRequest) -> Result<(), SkillRefusal> {
        let locked = self.authority.lock_for(&owner_of(request), LONGEST_LOCK);
        self.changed.send_replace(());
        locked
    }

    /// Shows that there is no lock, unless another session has locked the component meanwhile.
    fn show_end(&self) {
        let _shows = lock(&self.shows);
        if self.authority.locked_until().is_none() {
            self.show(None);
        }
    }

    async fn watch(self) {
        let mut changed = self.changed.subscribe();
        let mut holder = self.authority.holder();
        loop {
            let Some(until) = self.authority.locked_until() else {
                self.show_end();
                if changed.changed().await.is_err() {
                    return;
                }
                continue;
            };
            tokio::select! {
                renewed = changed.changed() => if renewed.is_err() { return },
                // The session lost the lease, and the lock with it.
                lost = holder.changed() => if lost.is_err() { return },
                () = sleep_until(until) => {
                    let _previous = self.authority.expire_lock(Instant::now());
                }
            }
        }
    }

    fn show(&self, by: Option<(&str, &str)>) {
        let (client, user) = by.unwrap_or_default();
        let remaining = if by.is_some() {
            LONGEST_LOCK
        } else {
            Duration::ZERO
        };
        let values = [
            ("Locked", Variant::from(by.is_some())),
            ("LockingClient", Variant::from(client)),
            ("LockingUser", Variant::from(user)),
            (
                "RemainingLockTime",
                Variant::from(remaining.as_secs_f64() * 1_000.0),
            ),
        ];
        for (name, value) in values {
            if let Some(node) = self.object.node(name) {
                // The node exists as long as the server.
                let _shown = self.server.show(node, value);
            }
        }
    }
}

fn owner_of(request: &MethodRequest) -> SkillOwner {
    SkillOwner::Session(request.caller.session)
}

type Answer = Result<i32, StatusCode>;

/// Return values of the methods (OPC 10000-100, 7.4 and following).
const DONE: i32 = 0;
const ALREADY_LOCKED: i32 = -1;
const NOT_LOCKED: i32 = -1;
/// MaxInactiveLockTime: a lock that is not renewed ends after this time.
const LONGEST_LOCK: Duration = Duration::from_secs(600);

//! The register of applications (OPC 10000-12, 6.6).

use opcua::types::{ExtensionObject, NodeId, StatusCode, UAString, Variant};
use plant_opcua::server::{MethodRequest, SessionCaller};
use tracing::info;

use crate::records::{ApplicationQuery, GdsRecord, check};
use crate::service::{
    CallerStanding, Gds, MethodResult, id, number, refused, texts, time, unregistered,
};
use plant_opcua::directory::ApplicationRecord;

/// FindApplications: returns the applications with an ApplicationUri.
pub(crate) fn find(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [Variant::String(uri)] = request.arguments.as_slice() else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let records = gds.records.lock();
    let found = records.of_uri(uri.as_ref());
    let told: Vec<ExtensionObject> = found.map(told).collect();
    Ok(vec![Variant::from(told)])
}

/// RegisterApplication: returns the ApplicationId.
pub(crate) fn register(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let id = gds.register(&request.caller, GdsRecord::of(record(request)?, 0))?;
    Ok(vec![Variant::from(id)])
}

/// UpdateApplication: changes everything except the ApplicationUri.
pub(crate) fn update(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let told = record(request)?;
    let known = gds.own(&request.caller, &told.application_id)?;
    gds.update(&request.caller, GdsRecord::of(told, known.number))?;
    Ok(Vec::new())
}

impl Gds {
    /// Registers an application, and returns its ApplicationId. An administrator confirms the
    /// hosts of its DiscoveryUrls.
    ///
    /// # Errors
    /// The status for the caller.
    pub(crate) fn register(
        &self,
        caller: &SessionCaller,
        mut record: GdsRecord,
    ) -> Result<NodeId, StatusCode> {
        match self.standing(caller, &record.uri)? {
            CallerStanding::Administrator => record.confirm(&record.hosts()),
            CallerStanding::Itself => {}
            CallerStanding::Applicant(key) => {
                check(&record).map_err(|fault| unregistered(&fault, caller))?;
                return Ok(self.applicants.lock().put(record, key));
            }
            CallerStanding::Stranger => return Err(StatusCode::BadUserAccessDenied),
        }
        let (uri, urls) = (record.uri.clone(), record.urls.clone());
        let registered = self.records.lock().register(record);
        let number = registered.map_err(|fault| unregistered(&fault, caller))?;
        info!(application = ?uri, ?urls, number, by = ?caller.user, "registered an application");
        Ok(id(number))
    }

    /// Updates the record of an application that the caller may change. An administrator confirms
    /// the hosts of its DiscoveryUrls.
    ///
    /// # Errors
    /// The status for the caller.
    pub(crate) fn update(
        &self,
        caller: &SessionCaller,
        mut record: GdsRecord,
    ) -> Result<(), StatusCode> {
        if self.is_administrator(caller) {
            record.confirm(&record.hosts());
        }
        let uri = record.uri.clone();
        let updated = self.records.lock().update(record);
        updated.map_err(|fault| unregistered(&fault, caller))?;
        info!(application = ?uri, by = ?caller.user, "changed the registration of an application");
        Ok(())
    }
}

/// UnregisterApplication: its certificates are revoked (OPC 10000-12, 6.6.8).
pub(crate) fn unregister(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [Variant::NodeId(id)] = request.arguments.as_slice() else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let caller = &request.caller;
    let known = gds.own(caller, id)?;
    let issued = gds.store.lock().of_application(&known.uri);
    let issued = issued.map_err(|fault| refused(&fault))?;
    let now = crate::service::now();
    gds.revoke(&issued, now).map_err(|fault| refused(&fault))?;
    let gone = gds.records.lock().remove(known.number);
    gone.map_err(|fault| unregistered(&fault, caller))?;
    info!(application = ?known.uri, by = ?caller.user, "removed the registration of an application");
    Ok(Vec::new())
}

/// GetApplication: returns the application with an ApplicationId.
pub(crate) fn get(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [Variant::NodeId(id)] = request.arguments.as_slice() else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let records = gds.records.lock();
    let known = number(id).and_then(|number| records.get(number));
    let known = known.ok_or(StatusCode::BadNotFound)?;
    Ok(vec![Variant::from(told(known))])
}

/// QueryApplications: returns the descriptions of applications, and the number after which the next
/// query continues.
pub(crate) fn query(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [
        Variant::UInt32(after),
        Variant::UInt32(most),
        Variant::String(name),
        Variant::String(uri),
        Variant::UInt32(kinds),
        Variant::String(product_uri),
        capabilities,
    ] = request.arguments.as_slice()
    else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let capabilities = texts(capabilities);
    let numbers = (*after, *most, *kinds);
    let query = looked_for(numbers, [name, uri, product_uri], &capabilities)?;
    let records = gds.records.lock();
    let (found, next) = records.query(&query);
    let found: Vec<ExtensionObject> = found
        .into_iter()
        .map(|one| ExtensionObject::from_message(one.described()))
        .collect();
    Ok(vec![
        time(records.since()),
        Variant::UInt32(next),
        Variant::from(found),
    ])
}

/// QueryServers: returns servers only, in the form of FindServersOnNetwork (OPC 10000-12, 6.6.11).
pub(crate) fn query_servers(gds: &Gds, request: &MethodRequest) -> MethodResult {
    let [
        Variant::UInt32(after),
        Variant::UInt32(most),
        Variant::String(name),
        Variant::String(uri),
        Variant::String(product_uri),
        capabilities,
    ] = request.arguments.as_slice()
    else {
        return Err(StatusCode::BadInvalidArgument.into());
    };
    let capabilities = texts(capabilities);
    let numbers = (*after, *most, SERVERS);
    let query = looked_for(numbers, [name, uri, product_uri], &capabilities)?;
    let records = gds.records.lock();
    let (found, _) = records.query(&query);
    let found: Vec<ExtensionObject> = found
        .into_iter()
        .map(|one| ExtensionObject::from_message(one.on_network()))
        .collect();
    Ok(vec![time(records.since()), Variant::from(found)])
}

/// Returns the query of these arguments: the number after which it continues, the largest number of
/// results, and the kinds; name, ApplicationUri and ProductUri.
fn looked_for<'q>(
    (after, most, kinds): (u32, u32, u32),
    [name, uri, product_uri]: [&'q UAString; 3],
    capabilities: &'q [String],
) -> Result<ApplicationQuery<'q>, StatusCode> {
    // Every client may send queries, and each character of a pattern is compared with each
    // character of a name.
    if name.as_ref().len() > LONGEST_PATTERN {
        return Err(StatusCode::BadInvalidArgument);
    }
    Ok(ApplicationQuery {
        after,
        most,
        name: name.as_ref(),
        uri: uri.as_ref(),
        kinds,
        product_uri: product_uri.as_ref(),
        capabilities: capabilities.iter().map(String::as_str).collect(),
    })
}

fn told(record: &GdsRecord) -> ExtensionObject {
    ExtensionObject::new(record.told(id(record.number)))
}

/// Returns the application that is the only argument.
fn record(request: &MethodRequest) -> Result<&ApplicationRecord, StatusCode> {
    let [Variant::ExtensionObject(told)] = request.arguments.as_slice() else {
        return Err(StatusCode::BadInvalidArgument);
    };
    told.inner_as::<ApplicationRecord>()
        .ok_or(StatusCode::BadInvalidArgument)
}

/// Size limit of a name pattern, in bytes.
const LONGEST_PATTERN: usize = 256;
/// Servers, among the kinds of a query.
const SERVERS: u32 = 1;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pattern_that_would_be_held_against_names_for_minutes_is_refused() {
        let refused = |length: usize| {
            let name = UAString::from("%".repeat(length));
            let none = UAString::null();
            looked_for((0, 0, 0), [&name, &none, &none], &[]).err()
        };
        assert_eq!(refused(LONGEST_PATTERN), None);
        assert_eq!(
            refused(LONGEST_PATTERN + 1),
            Some(StatusCode::BadInvalidArgument)
        );
    }
}

//! The hosts that a certificate may name. Loopback hosts and confirmed hosts need no decision. Any
//! other host waits for an administrator, also if the DiscoveryUrls name it, because an
//! application registers its DiscoveryUrls itself.

use std::net::IpAddr;

use opcua::types::StatusCode;
use plant_opcua::server::{MethodRefusal, SessionCaller};
use tracing::warn;
use trust::Certificate;

use crate::manager::unfit;
use crate::records::{GdsRecord, has_host};
use crate::service::{Gds, refused};

/// The outcome for the hosts of a request without an administrator.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum HostCheck {
    /// All hosts are confirmed.
    Confirmed,
    /// These hosts are in the DiscoveryUrls, but not confirmed.
    Unconfirmed(Vec<String>),
    /// This host is in no DiscoveryUrl.
    Unregistered(String),
}

impl HostCheck {
    /// Compares requested hosts with the hosts of the DiscoveryUrls and the confirmed hosts.
    pub(crate) fn of(hosts: &[String], registered: &[String], confirmed: &[String]) -> Self {
        let open = |host: &&String| !is_loopback(host) && !has_host(confirmed, host);
        let open: Vec<String> = hosts.iter().filter(open).cloned().collect();
        match open.iter().find(|host| !has_host(registered, host)) {
            Some(host) => Self::Unregistered(host.clone()),
            None if open.is_empty() => Self::Confirmed,
            None => Self::Unconfirmed(open),
        }
    }
}

impl Gds {
    /// Returns the hosts of a request that wait for an administrator.
    ///
    /// # Errors
    /// A host that is in no DiscoveryUrl of the application.
    pub(crate) fn unconfirmed_hosts(
        &self,
        caller: &SessionCaller,
        record: &GdsRecord,
        hosts: &[String],
    ) -> Result<Vec<String>, MethodRefusal> {
        if self.is_administrator(caller) {
            return Ok(Vec::new());
        }
        let confirmed = self.confirmed_hosts(caller, &record.uri)?;
        match HostCheck::of(hosts, &record.hosts(), &confirmed) {
            HostCheck::Confirmed => Ok(Vec::new()),
            HostCheck::Unconfirmed(hosts) => Ok(hosts),
            HostCheck::Unregistered(host) => Err(unregistered(record, &host)),
        }
    }

    /// Returns whether an application may have a certificate for these hosts without an
    /// administrator.
    ///
    /// # Errors
    /// The issued certificates cannot be read.
    pub(crate) fn are_confirmed(
        &self,
        caller: &SessionCaller,
        uri: &str,
        hosts: &[String],
    ) -> Result<bool, StatusCode> {
        let confirmed = self.confirmed_hosts(caller, uri)?;
        Ok(HostCheck::of(hosts, &[], &confirmed) == HostCheck::Confirmed)
    }

    /// Checks that the DiscoveryUrls or the current certificate of an application name all hosts.
    ///
    /// # Errors
    /// A host that they do not name.
    pub(crate) fn require_registered_hosts(
        &self,
        record: &GdsRecord,
        hosts: &[String],
    ) -> Result<(), MethodRefusal> {
        let issued = self.issued_hosts(&record.uri)?;
        match HostCheck::of(hosts, &record.hosts(), &issued) {
            HostCheck::Confirmed | HostCheck::Unconfirmed(_) => Ok(()),
            HostCheck::Unregistered(host) => Err(unregistered(record, &host)),
        }
    }

    /// Logs which hosts of a request wait, and which command approves the request.
    pub(crate) fn report_unconfirmed(&self, record: &GdsRecord, number: u32, hosts: &[String]) {
        if hosts.is_empty() {
            return;
        }
        if let Some(suppressed) = self.another(&format!("hosts {number}")) {
            warn!(
                application = ?record.uri, number, ?hosts, suppressed,
                "a certificate request waits, because no administrator has confirmed these \
                 hosts: `ua-gds approve {number}` or `ua-gds reject {number}`"
            );
        }
    }

    /// Returns the hosts that an administrator, the latest certificate from here, or the trusted
    /// certificate of the caller confirms.
    fn confirmed_hosts(
        &self,
        caller: &SessionCaller,
        uri: &str,
    ) -> Result<Vec<String>, StatusCode> {
        let mut hosts = self.issued_hosts(uri)?;
        // An untrusted certificate of the same key may name any host.
        let shown = Self::proof(caller, uri).filter(|shown| self.is_trusted(shown));
        hosts.extend(shown.iter().flat_map(Certificate::hosts));
        let records = self.records.lock();
        for record in records.of_uri(uri) {
            hosts.extend_from_slice(&record.confirmed);
        }
        Ok(hosts)
    }

    fn issued_hosts(&self, uri: &str) -> Result<Vec<String>, StatusCode> {
        let issued = self.store.lock().of_application(uri);
        let issued = issued.map_err(|fault| refused(&fault))?;
        Ok(issued.first().map(Certificate::hosts).unwrap_or_default())
    }
}

/// Returns whether a host is the computer itself, wherever that is.
fn is_loopback(host: &str) -> bool {
    match host.parse::<IpAddr>() {
        Ok(address) => address.is_loopback(),
        Err(_) => host.eq_ignore_ascii_case("localhost"),
    }
}

fn unregistered(record: &GdsRecord, host: &str) -> MethodRefusal {
    unfit(
        record,
        &format!(
            "the host {host:?} is in none of its DiscoveryUrls; register the application with it, or ask as a user with \
             the role security_admin"
        ),
    )
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::PathBuf;
    use std::sync::Arc;
    use std::time::Duration;

    use log_limit::LogLimit;
    use opcua::sync::Mutex;
    use plant_opcua::judge::CertificateJudge;
    use plant_opcua::users::{Roles, UserAccess, UserRole};
    use trust::{CertificateAuthority, CertificateSigningRequest, Issue, Serial};

    use super::*;
    use crate::invitations::{self, Invitations, RANDOM};
    use crate::kept;
    use crate::records::Records;
    use crate::requests::{FILE, RequestState, SigningRequests};
    use crate::service::{CallerStanding, now};
    use crate::store::{AuthorityStore, new_key};

    const YEAR: Duration = Duration::from_secs(365 * 86_400);
    const URI: &str = "urn:cell:robot";

    /// A server with an authority, where anonymous users are administrators.
    struct Site {
        folder: PathBuf,
        gds: Gds,
        key: Vec<u8>,
    }

    impl Site {
        fn new(name: &str) -> Self {
            let folder = format!("ua-gds-hosts-{}-{name}", std::process::id());
            let folder = std::env::temp_dir().join(folder);
            drop(fs::remove_dir_all(&folder));
            let store =
                AuthorityStore::init(&folder, ("Plant authority", ""), now(), YEAR).unwrap();
            let pki = folder.join("pki");
            fs::create_dir_all(&pki).unwrap();
            let records = Records::open(folder.join("applications.json"), now().as_secs());
            let administrators = Roles::of(&[UserRole::SecurityAdmin]);
            let gds = Gds {
                store: Mutex::new(store),
                records: Mutex::new(records.unwrap()),
                applicants: Mutex::default(),
                keys: Mutex::default(),
                folder: folder.clone(),
                judge: CertificateJudge::of(&pki, false),
                logged: Mutex::new(LogLimit::every(YEAR)),
                known: Mutex::default(),
                access: Arc::new(UserAccess::of_store(None, administrators).unwrap()),
                pki,
                life: YEAR,
                namespace: 2,
            };
            let key = new_key(2048).unwrap();
            Self { folder, gds, key }
        }

        fn request(&self, hosts: &[&str]) -> CertificateSigningRequest {
            let hosts: Vec<String> = hosts.iter().map(|host| (*host).to_owned()).collect();
            CertificateSigningRequest::make(&self.key, URI, ("Robot", ""), &hosts).unwrap()
        }

        /// The application, with a certificate that the authority issued for these hosts.
        fn robot(&self, hosts: &[&str]) -> SessionCaller {
            let store = self.gds.store.lock();
            let issued = store.issue(&self.request(hosts), now(), YEAR).unwrap();
            drop(store);
            shows(&issued)
        }

        /// A certificate of the key of the application for these hosts, of another authority.
        fn self_made(&self, hosts: &[&str]) -> Certificate {
            let issue = Issue {
                serial: Serial::random([7; 16]),
                from: now().saturating_sub(YEAR),
                until: now() + YEAR,
            };
            let authority =
                CertificateAuthority::make(&self.key, ("Laboratory", ""), &issue).unwrap();
            authority.issue(&self.request(hosts), &issue).unwrap()
        }

        /// Requests a certificate, and returns the number of the request.
        fn ask(&self, caller: &SessionCaller, hosts: &[&str]) -> Result<u32, MethodRefusal> {
            let (record, standing) = self.registered(caller);
            let asked = (&record, standing);
            self.gds.ask(caller, asked, self.request(hosts))
        }

        /// Fetches the certificate of a request, and returns its hosts.
        fn fetch(&self, caller: &SessionCaller, number: u32) -> Result<Vec<String>, MethodRefusal> {
            let (record, standing) = self.registered(caller);
            let issued = self.gds.fetch(caller, (&record, standing), number);
            issued.map(|issued| issued.hosts())
        }

        fn registered(&self, caller: &SessionCaller) -> (GdsRecord, CallerStanding) {
            let record = self.gds.records.lock().of_uri(URI).next().cloned();
            (record.unwrap(), self.gds.standing(caller, URI).unwrap())
        }

        fn approve(&self, number: u32) {
            let decided = kept::change(&self.folder.join(FILE), |all: &mut SigningRequests| {
                let by = "the command line".to_owned();
                all.decide(number, RequestState::Approved { by }, now())
                    .is_some()
            });
            assert!(decided.unwrap());
        }
    }

    impl Drop for Site {
        fn drop(&mut self) {
            drop(fs::remove_dir_all(&self.folder));
        }
    }

    /// The application, with that certificate.
    fn shows(certificate: &Certificate) -> SessionCaller {
        SessionCaller {
            certificate: Some(Arc::from(certificate.der())),
            ..caller("robot")
        }
    }

    fn caller(user: &str) -> SessionCaller {
        SessionCaller {
            session: 1,
            user: user.to_owned(),
            application_uri: URI.to_owned(),
            proven: true,
            encrypted: true,
            certificate: None,
        }
    }

    fn record(number: u32, hosts: &[&str]) -> GdsRecord {
        let url = |host: &&str| format!("opc.tcp://{host}:4840");
        GdsRecord {
            number,
            uri: URI.to_owned(),
            kind: 0,
            names: vec![("en".to_owned(), "Robot".to_owned())],
            product_uri: "urn:maker".to_owned(),
            urls: hosts.iter().map(url).collect(),
            capabilities: vec!["DA".to_owned()],
            confirmed: Vec::new(),
        }
    }

    fn waits() -> Result<Vec<String>, MethodRefusal> {
        Err(StatusCode::BadRequestNotComplete.into())
    }

    #[test]
    fn hosts_are_confirmed_loopback_or_wait_and_others_are_refused() {
        let all = |hosts: &[&str]| -> Vec<String> {
            hosts.iter().map(|host| (*host).to_owned()).collect()
        };
        let (registered, confirmed) = (all(&["robot.cell", "mes.cell"]), all(&["robot.cell"]));
        let check = |hosts: &[&str]| HostCheck::of(&all(hosts), &registered, &confirmed);
        let own = check(&["Robot.CELL", "localhost", "127.0.0.1", "::1"]);
        assert_eq!(own, HostCheck::Confirmed);
        let waits = HostCheck::Unconfirmed(all(&["mes.cell"]));
        assert_eq!(check(&["robot.cell", "mes.cell"]), waits);
        let refused = HostCheck::Unregistered("lab.cell".to_owned());
        assert_eq!(check(&["mes.cell", "lab.cell"]), refused);
    }

    #[test]
    fn a_host_that_an_application_registers_for_itself_waits_until_it_is_approved() {
        let site = Site::new("own");
        let robot = site.robot(&["robot.cell"]);
        let gds = &site.gds;
        let id = gds.register(&robot, record(0, &["robot.cell"])).unwrap();
        let number = crate::service::number(&id).unwrap();
        // The current certificate names the host.
        let request = site.ask(&robot, &["robot.cell"]).unwrap();
        assert_eq!(site.fetch(&robot, request).unwrap(), ["robot.cell"]);

        let both = ["robot.cell", "mes.cell"];
        gds.update(&robot, record(number, &both)).unwrap();
        let request = site.ask(&robot, &both).unwrap();
        assert_eq!(site.fetch(&robot, request), waits());
        let again = site.ask(&robot, &both).unwrap();
        assert_eq!(again, request, "a repeated request approves nothing");
        assert_eq!(site.fetch(&robot, request), waits());
        site.approve(request);
        assert_eq!(site.fetch(&robot, request).unwrap(), both);
        // The approval stays with the record, also when a later certificate leaves the host out.
        let request = site.ask(&robot, &["robot.cell"]).unwrap();
        assert_eq!(site.fetch(&robot, request).unwrap(), ["robot.cell"]);
        let request = site.ask(&robot, &both).unwrap();
        assert_eq!(site.fetch(&robot, request).unwrap(), both);
        // A host without DiscoveryUrl is refused.
        let refused: Result<u32, MethodRefusal> = Err(StatusCode::BadInvalidArgument.into());
        assert_eq!(site.ask(&robot, &["lab.cell"]), refused);
    }

    #[test]
    fn an_administrator_confirms_the_hosts_of_a_record() {
        let site = Site::new("administrator");
        let (robot, sara) = (site.robot(&[]), caller("anonymous"));
        let id = site.gds.register(&sara, record(0, &["robot.cell"]));
        let number = crate::service::number(&id.unwrap()).unwrap();
        let request = site.ask(&robot, &["robot.cell"]).unwrap();
        assert_eq!(site.fetch(&robot, request).unwrap(), ["robot.cell"]);
        site.gds
            .update(&sara, record(number, &["mes.cell"]))
            .unwrap();
        let request = site.ask(&robot, &["mes.cell"]).unwrap();
        assert_eq!(site.fetch(&robot, request).unwrap(), ["mes.cell"]);
    }

    #[test]
    fn an_invitation_confirms_the_hosts_of_the_first_request_only() {
        let site = Site::new("invited");
        let gds = &site.gds;
        let stranger = shows(&site.self_made(&["mes.cell"]));
        let id = gds.register(&stranger, record(0, &["robot.cell"])).unwrap();
        let applicant = gds.applicants.lock().get(&id).cloned().unwrap();
        let standing = gds.standing(&stranger, URI).unwrap();
        let token = kept::change(
            &site.folder.join(invitations::FILE),
            |all: &mut Invitations| all.add(&[7; RANDOM], None, (now(), YEAR)),
        );
        let token = token.unwrap();
        let hosts = ["robot.cell".to_owned()];
        let names = ("Robot", "");
        let wanted = CertificateSigningRequest::make_with(
            &site.key,
            (URI, &hosts),
            names,
            Some(token.secret()),
        );
        let asked = (&applicant, standing);
        let request = gds.ask(&stranger, asked, wanted.unwrap()).unwrap();
        assert_eq!(site.fetch(&stranger, request).unwrap(), hosts);
        let (known, standing) = site.registered(&stranger);
        assert_eq!(standing, CallerStanding::Itself);
        assert_eq!(known.confirmed, hosts);

        let both = ["robot.cell", "mes.cell"];
        gds.update(&stranger, record(known.number, &both)).unwrap();
        let request = site.ask(&stranger, &both).unwrap();
        assert_eq!(site.fetch(&stranger, request), waits());
    }

    #[test]
    fn a_certificate_confirms_its_hosts_only_if_it_is_trusted() {
        let site = Site::new("trusted");
        let _known = site.robot(&[]);
        let self_made = site.self_made(&["mes.cell"]);
        let robot = shows(&self_made);
        site.gds.register(&robot, record(0, &["mes.cell"])).unwrap();
        let request = site.ask(&robot, &["mes.cell"]).unwrap();
        assert_eq!(site.fetch(&robot, request), waits());
        let trusted = site.gds.pki.join(plant_opcua::known::TRUSTED);
        fs::create_dir_all(&trusted).unwrap();
        fs::write(trusted.join("robot.der"), self_made.der()).unwrap();
        assert_eq!(site.fetch(&robot, request).unwrap(), ["mes.cell"]);
    }

    #[test]
    fn an_administrator_that_fetches_a_certificate_confirms_its_hosts() {
        let site = Site::new("fetched");
        let (robot, sara) = (site.robot(&[]), caller("anonymous"));
        site.gds.register(&robot, record(0, &["mes.cell"])).unwrap();
        let request = site.ask(&robot, &["mes.cell"]).unwrap();
        assert_eq!(site.fetch(&robot, request), waits());
        assert_eq!(site.fetch(&sara, request).unwrap(), ["mes.cell"]);
        assert_eq!(site.registered(&sara).0.confirmed, ["mes.cell"]);
    }
}

//! Certificates that authorities issue and revoke: clients with an issued certificate are admitted
//! without being known. Checked with asyncua and authorities made by another library.

use std::fs;

use system_tests::{Cell, Peer, SERVER_ENDPOINT, eventually};

use super::SOON;
use super::access::{AccessSite, path, verb};

const SETPOINT: &str = "ns=2;i=30";
const WAY: &str = "Basic256Sha256/SignAndEncrypt";
const MAPPING: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
variables:
  - {node: ns=2;i=30, name: setpoint, type: Double, origin: 0}
";

/// Starts a server that trusts an authority, with certificates of that and other authorities in the
/// folder of the clients.
fn site() -> Option<AccessSite> {
    let cell = Cell::with(&[Peer::Python])?;
    let pairs = cell.folder().join("pairs");
    let made = cell.asyncua_once("opcua_access.py", &["issued", path(&pairs)]);
    assert_eq!(made.len(), 1);
    let plant = pairs.join("plant.der");
    let told = verb(&cell, &["trust", path(&plant)], "");
    let told = String::from_utf8(told.stdout).unwrap();
    assert!(
        told.contains("authority") && told.contains("first authority"),
        "{told}"
    );
    let file = cell.file("access.yaml", MAPPING);
    let server = cell.ua_server(&[path(&file)]);
    let site = AccessSite { cell, server };
    eventually("the server answers clients", SOON, || {
        site.cell
            .asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    Some(site)
}

fn takes(site: &AccessSite, file: &str) {
    let file = site.cell.folder().join("pairs").join(file);
    site.told(&["trust", path(&file)], "");
}

fn outcome(site: &AccessSite, client: &str) -> String {
    let tried = site
        .tries(SETPOINT, WAY, "anonymous", &["--client", client])
        .remove(0);
    tried["connected"].as_str().unwrap().to_owned()
}

/// Waits until a client has this outcome; the server checks its store once a second.
fn becomes(site: &AccessSite, client: &str, wanted: &str) {
    eventually(&format!("{client}: {wanted}"), SOON, || {
        (outcome(site, client) == wanted).then_some(())
    });
}

#[test]
fn whom_a_trusted_authority_issued_a_certificate_is_let_in_and_each_fault_has_its_status() {
    let Some(mut site) = site() else { return };
    assert_eq!(outcome(&site, "client"), "BadCertificateRevocationUnknown");
    site.server.wait_for_line("revocation list", SOON);
    takes(&site, "plant.crl");
    becomes(&site, "client", "Good");
    let tried = site.tries(SETPOINT, WAY, "anonymous", &[]).remove(0);
    assert_eq!(tried["write"], "Good", "{tried}");
    for (client, wanted) in [
        ("gone", "BadCertificateRevoked"),
        ("late", "BadCertificateTimeInvalid"),
        // A stranger does not learn the reason.
        ("stranger", "BadSecurityChecksFailed"),
        ("below", "BadSecurityChecksFailed"),
        ("orphan", "BadSecurityChecksFailed"),
    ] {
        assert_eq!(outcome(&site, client), wanted, "{client}");
    }
    site.server.wait_for_line("certificate is revoked", SOON);
    let listed = site.told(&["certificates"], "");
    assert!(
        !listed
            .lines()
            .any(|line| line.starts_with("trusted") && line.contains("\"client\"")),
        "{listed}"
    );
    let left = site.cell.folder().join("pki/admitted/trusted");
    eventually("nobody is let in any longer", SOON, || {
        fs::read_dir(&left).ok()?.next().is_none().then_some(())
    });
    // An intermediate authority becomes known, and then its revocation lists.
    let between = site.cell.folder().join("pairs/between.der");
    site.told(&["trust", "--issuer", path(&between)], "");
    becomes(&site, "below", "BadCertificateRevocationUnknown");
    takes(&site, "between.crl");
    becomes(&site, "below", "Good");
    takes(&site, "plant-all.crl");
    becomes(&site, "below", "BadCertificateIssuerRevoked");
    takes(&site, "over.der");
    takes(&site, "over.crl");
    becomes(&site, "orphan", "BadCertificateIssuerTimeInvalid");
    // A stranger that an administrator trusts is admitted, but its authority is not.
    let stranger = site.cell.folder().join("pairs/stranger_certificate.der");
    site.told(&["trust", path(&stranger)], "");
    becomes(&site, "stranger", "Good");
}

#[test]
fn a_client_whose_certificate_is_revoked_is_cut_off() {
    let Some(mut site) = site() else { return };
    takes(&site, "plant.crl");
    becomes(&site, "client", "Good");
    let folder = site.cell.folder().join("pairs");
    let held = ["hold", SERVER_ENDPOINT, path(&folder), "--ways", WAY];
    let mut holder = site.cell.asyncua("opcua_access.py", &held);
    takes(&site, "plant-now.crl");
    holder.wait_for_line("cut_off", SOON);
    site.server.wait_for_line("is cut off", SOON);
    assert_eq!(outcome(&site, "client"), "BadCertificateRevoked");
}

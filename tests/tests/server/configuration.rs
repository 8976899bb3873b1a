//! The certificates of the server, managed over OPC UA: asyncua is the administrator, and another
//! library the authority.

use serde_json::json;
use system_tests::{SERVER_ENDPOINT, eventually};

use super::SOON;
use super::access::{AccessSite, PASSWORD, path};

const MAPPING: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
variables:
  - {node: ns=2;i=30, name: setpoint, type: Double, origin: 0}
";
const SETPOINT: &str = "ns=2;i=30";

#[test]
fn an_administrator_gives_the_server_another_certificate_and_says_whom_it_trusts() {
    let Some(site) = AccessSite::with(MAPPING, &[]) else {
        return;
    };
    let client = site.pair("client");
    site.told(&["trust", &client], "");
    for (name, role) in [("sara", "security_admin"), ("anna", "engineer")] {
        let args = ["user", "add", name, "--role", role];
        site.told(&args, &format!("{PASSWORD}\n"));
    }
    let folder = site.cell.folder().join("pairs");
    let asked = |verb: &str, more: &[&str]| {
        let args = [&[verb, SERVER_ENDPOINT, path(&folder)], more].concat();
        site.cell.asyncua_once("opcua_push.py", &args).remove(0)
    };
    let sara = ["--user", "sara", "--password", PASSWORD];
    eventually("sara is known", SOON, || {
        let args = [&["refused", SERVER_ENDPOINT, path(&folder)][..], &sara].concat();
        site.cell.asyncua_try("opcua_push.py", &args)
    });
    // Refused: an engineer, an anonymous user, and the administrator over an unencrypted channel.
    let anna = ["--user", "anna", "--password", PASSWORD];
    for who in [&anna[..], &[]] {
        let said = asked("refused", who);
        let denied = json!({"request": "BadUserAccessDenied", "apply": "BadUserAccessDenied", "open": "BadUserAccessDenied"});
        assert_eq!(said, denied, "{who:?}");
    }
    let read = [&sara[..], &["--way", "Basic256Sha256/Sign"]].concat();
    let said = asked("refused", &read);
    assert_eq!(said["request"], "BadSecurityModeInsufficient", "{said}");
    assert_eq!(said["open"], "BadSecurityModeInsufficient", "{said}");
    // A stranger, which is refused and listed as rejected.
    let way = "Basic256Sha256/SignAndEncrypt";
    let stranger = site.tries(SETPOINT, way, "anonymous", &["--client", "user"]);
    assert_ne!(stranger[0]["connected"], "Good", "{stranger:?}");

    let said = asked("push", &sara);
    assert_eq!(
        said,
        json!({
            "trusted_before": 1,
            "short_nonce": "BadInvalidArgument",
            "request": {"signed": true, "subject": "CN=Cell server,O=Plant", "uri": said["request"]["uri"]},
            "wrong_uri": "BadInvalidArgument",
            "foreign": "BadInvalidArgument",
            "forged": "BadSecurityChecksFailed",
            "unknown_authority": "BadSecurityChecksFailed",
            "waits": true,
            "later": true,
            "trusted_after": [2, 1],
            "rejected": true,
            "added": "Good",
            "removed": "Good",
            "removed_again": "BadInvalidArgument",
        })
    );
    // The same process restarts the server with the new key pair and admits a client with a
    // certificate of the authority.
    let shown = eventually("the server shows the new certificate", SOON, || {
        let args = ["shown", SERVER_ENDPOINT, path(&folder)];
        let said = site.cell.asyncua_try("opcua_push.py", &args)?.remove(0);
        (said["new"] == true).then_some(said)
    });
    assert_eq!(shown["state"], 0, "{shown}");
    let tried = site.tries(SETPOINT, way, "anonymous", &["--client", "issued"]);
    assert_eq!(tried[0]["connected"], "Good", "{tried:?}");
}

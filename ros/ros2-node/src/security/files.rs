//! Checks the files of an enclave before RustDDS reads them: RustDDS reports a failed verification
//! without the file to fix, and checks neither the dates of certificates nor the file mode of a
//! key.

use std::fs::{self, File};
use std::io::Read as _;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use openssl::asn1::Asn1Time;
use openssl::error::ErrorStack;
use openssl::pkcs7::{Pkcs7, Pkcs7Flags};
use openssl::pkey::{PKey, Private};
use openssl::stack::Stack;
use openssl::x509::X509;
use openssl::x509::store::X509StoreBuilder;

use super::{DdsSecurityError, Enclave, REVOKED};

/// Checks all files in `folder`; returns advice about faults that do not prevent operation.
pub(super) fn check(folder: &Path) -> Result<Vec<String>, DdsSecurityError> {
    if folder.join(REVOKED).is_file() {
        return Err(Enclave::fault(
            folder,
            REVOKED,
            "RustDDS ignores this list of revoked certificates and would accept them: create a new keystore \
             without the revoked nodes",
        ));
    }
    let identity_ca = certificate(folder, "identity_ca.cert.pem")?;
    let permissions_ca = certificate(folder, "permissions_ca.cert.pem")?;
    let own = certificate(folder, "cert.pem")?;
    let fault = |file: &str, why: &str| Err(Enclave::fault(folder, file, why));

    let signed = identity_ca.public_key().and_then(|ca| own.verify(&ca));
    if !signed.unwrap_or(false) {
        return fault(
            "cert.pem",
            "this certificate is not signed by identity_ca.cert.pem: use both files from the same keystore",
        );
    }
    let key = private_key(folder)?;
    if !own.public_key().is_ok_and(|public| public.public_eq(&key)) {
        return fault(
            "key.pem",
            "this key does not match cert.pem: use both files from the same enclave",
        );
    }
    let governance = signed_document(folder, GOVERNANCE, &permissions_ca)?;
    signed_document(folder, "permissions.p7s", &permissions_ca)?;
    let hidden =
        not_found(&governance).map(|why| format!("{}: {why}", folder.join(GOVERNANCE).display()));
    Ok(hidden
        .into_iter()
        .chain(readable_by_others(folder))
        .collect())
}

fn read(folder: &Path, file: &str) -> Result<Vec<u8>, DdsSecurityError> {
    let mut bytes = Vec::new();
    File::open(folder.join(file))
        .and_then(|opened| opened.take(LARGEST + 1).read_to_end(&mut bytes))
        .map_err(|error| Enclave::fault(folder, file, format!("cannot be read: {error}")))?;
    match u64::try_from(bytes.len()) {
        Ok(length) if length <= LARGEST => Ok(bytes),
        _ => Err(Enclave::fault(folder, file, "it is larger than 4 MiB")),
    }
}

/// Maximum size of a file of an enclave in bytes.
const LARGEST: u64 = 4 << 20;

/// Reads a certificate that is currently valid.
fn certificate(folder: &Path, file: &str) -> Result<X509, DdsSecurityError> {
    let pem = read(folder, file)?;
    let fault = |why: String| Enclave::fault(folder, file, why);
    let found =
        X509::from_pem(&pem).map_err(|error| fault(format!("not a PEM certificate: {error}")))?;
    let now = Asn1Time::days_from_now(0).map_err(|error| fault(error.to_string()))?;
    if found.not_after() < &*now {
        return Err(fault(format!(
            "this certificate expired on {}: create the enclave again, or set the clock of this host",
            found.not_after()
        )));
    }
    if found.not_before() > &*now {
        return Err(fault(format!(
            "this certificate is not valid before {}: set the clock of this host",
            found.not_before()
        )));
    }
    Ok(found)
}

fn private_key(folder: &Path) -> Result<PKey<Private>, DdsSecurityError> {
    let pem = read(folder, "key.pem")?;
    let fault = |why: &str| Enclave::fault(folder, "key.pem", why);
    let text = String::from_utf8_lossy(&pem);
    if text.contains("ENCRYPTED") {
        return Err(fault(
            "this key is encrypted with a password: remove the password with `openssl pkey`",
        ));
    }
    if !text.contains("-----BEGIN PRIVATE KEY-----") {
        return Err(fault(
            "not a PKCS#8 key, as `ros2 security` writes it: convert it with `openssl pkcs8 -topk8 -nocrypt`",
        ));
    }
    PKey::private_key_from_pem(&pem).map_err(|error| fault(&format!("not a private key: {error}")))
}

/// Returns the content of an S/MIME document if the authority signed it.
fn signed_document(
    folder: &Path,
    file: &str,
    authority: &X509,
) -> Result<String, DdsSecurityError> {
    let text = read(folder, file)?;
    let verify = || -> Result<String, ErrorStack> {
        let (signature, content) = Pkcs7::from_smime(&text)?;
        let mut signers = Stack::new()?;
        signers.push(authority.clone())?;
        let nobody = X509StoreBuilder::new()?.build();
        // Verified with this certificate and no other included certificate; its own chain does not
        // matter (DDS Security 1.1, 9.4.1.1).
        let flags = Pkcs7Flags::NOINTERN | Pkcs7Flags::NOVERIFY;
        let mut said = Vec::new();
        let content = content.as_deref();
        signature.verify(&signers, &nobody, content, Some(&mut said), flags)?;
        Ok(String::from_utf8_lossy(&said).into_owned())
    };
    verify().map_err(|error| {
        let why = error.errors().last().and_then(|last| last.reason());
        Enclave::fault(
            folder,
            file,
            format!(
                "its signature is not from permissions_ca.cert.pem, or the text was changed after signing \
                 ({}): sign it again",
                why.unwrap_or("no reason given")
            ),
        )
    })
}

/// Returns the reason for which nodes of Cyclone DDS are not discovered, if the governance causes
/// this.
///
/// If whole datagrams are protected, the datagrams that announce topics have to be protected, too
/// (DDS Security 1.1, 8.4.2.4, table 27). Cyclone DDS 0.10 protects them only if discovery is
/// protected. RustDDS rejects unprotected datagrams, because any host could have sent them.
fn not_found(governance: &str) -> Option<String> {
    governance.split("</domain_rule>").find_map(|rule| {
        let rtps = values(rule, "rtps_protection_kind").find(|kind| *kind != "NONE")?;
        let discovery = values(rule, "discovery_protection_kind").any(|kind| kind == "NONE");
        let is_open = |on: &str| ["false", "0"].contains(&on.to_lowercase().as_str());
        let topics = values(rule, "enable_discovery_protection").any(is_open);
        let open = match (discovery, topics) {
            (true, _) => "discovery_protection_kind NONE",
            (false, true) => "topics whose enable_discovery_protection is false",
            (false, false) => return None,
        };
        Some(format!(
            "with rtps_protection_kind {rtps} and {open}, nodes of Cyclone DDS are not discovered: they \
             announce their topics in unprotected datagrams, which are dropped. Enable \
             discovery protection, or set rtps_protection_kind to NONE"
        ))
    })
}

/// Returns the contents of the elements with this name.
fn values<'a>(xml: &'a str, element: &str) -> impl Iterator<Item = &'a str> {
    let (start, end) = (format!("<{element}>"), format!("</{element}>"));
    let parts: Vec<&str> = xml.split(&start).skip(1).collect();
    let values = parts.into_iter();
    values.filter_map(move |part| Some(part.split_once(&end)?.0.trim()))
}

/// Returns advice about a key that other users than its owner can read.
fn readable_by_others(folder: &Path) -> Option<String> {
    let path = folder.join("key.pem");
    let mode = fs::metadata(&path).ok()?.permissions().mode() & 0o777;
    (mode & 0o077 != 0).then(|| {
        format!(
            "{}: other users of this host can read this key (mode {mode:o}): chmod 600",
            path.display()
        )
    })
}

const GOVERNANCE: &str = "governance.p7s";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_is_not_found_is_told_of_rule_by_rule() {
        let rule = |rtps: &str, discovery: &str, topics: &str| {
            format!(
                "<domain_rule><discovery_protection_kind>{discovery}</discovery_protection_kind>
                 <rtps_protection_kind> {rtps} </rtps_protection_kind>
                 <topic_rule><enable_discovery_protection>{topics}</enable_discovery_protection></topic_rule>
                 </domain_rule>"
            )
        };
        assert_eq!(not_found(&rule("SIGN", "ENCRYPT", "true")), None);
        assert_eq!(not_found(&rule("NONE", "NONE", "false")), None);
        let two = rule("NONE", "NONE", "false") + &rule("ENCRYPT", "SIGN", "TRUE");
        assert_eq!(not_found(&two), None);
        let why = not_found(&rule("SIGN", "NONE", "true")).unwrap();
        assert!(
            why.contains("SIGN and discovery_protection_kind NONE"),
            "{why}"
        );
        let why = not_found(&rule("SIGN", "SIGN", "FALSE")).unwrap();
        assert!(
            why.contains("enable_discovery_protection is false"),
            "{why}"
        );
    }
}

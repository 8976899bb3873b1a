//! An invitation to a plant: the URL of its Global Discovery Server, the fingerprint of the
//! server's certificate, and a one-time token, with which the first certificate is issued without
//! an administrator.
//!
//! An invitation is a text without characters that a shell interprets:
//! `opc.tcp://10.80.0.1:4841,sha256=FINGERPRINT,token=TOKEN`.

use std::fmt;
use std::fs;
use std::io::Read as _;
use std::path::Path;
use std::str::FromStr;

use trust::Fingerprint;

use crate::endpoint::EndpointUrl;

/// The option of every program with an OPC UA certificate.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct GdsArguments {
    /// The Global Discovery Server of the plant, which issues and renews the certificate and
    /// provides the trust list: the invitation that `ua-gds invite` prints, only its URL, or @FILE
    /// with either
    #[arg(
        long,
        value_name = "INVITATION|URL|@FILE",
        env = "UA_GDS",
        hide_env_values = true
    )]
    pub gds: Option<GdsOption>,
}

impl GdsArguments {
    /// Reads the invitation; `None` without the option.
    ///
    /// # Errors
    /// Returns an error if the text or the file is not an invitation. The message omits the text,
    /// which may contain a token.
    pub fn invitation(&self) -> Result<Option<Invitation>, InvitationFault> {
        self.gds.as_ref().map(GdsOption::read).transpose()
    }
}

/// The unparsed value of `--gds`. It is never printed, because it may contain a token.
#[derive(Clone)]
pub struct GdsOption(String);

impl fmt::Debug for GdsOption {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("GdsOption(..)")
    }
}

impl FromStr for GdsOption {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(Self(text.to_owned()))
    }
}

impl GdsOption {
    fn read(&self) -> Result<Invitation, InvitationFault> {
        match self.0.strip_prefix('@') {
            Some(file) => text_of(Path::new(file))?.trim().parse(),
            None => self.0.trim().parse(),
        }
    }
}

fn text_of(file: &Path) -> Result<String, InvitationFault> {
    let failed = |error: std::io::Error| InvitationFault::File(format!("{error}"));
    let opened = fs::File::open(file).map_err(failed)?;
    let mut text = String::new();
    let read = opened.take(LONGEST).read_to_string(&mut text);
    read.map_err(failed)?;
    Ok(text)
}

/// The URL, the fingerprint and the token of a Global Discovery Server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Invitation {
    /// The endpoint URL of the server.
    pub url: String,
    /// The SHA-256 fingerprint of the server's certificate, which is trusted without a `trust`
    /// command.
    pub fingerprint: Option<Fingerprint>,
    /// The one-time token, with which the first certificate is issued at once.
    pub token: Option<Token>,
}

/// A one-time token. [`fmt::Display`] writes the token for the invitation; [`fmt::Debug`] does not.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl Token {
    /// Creates a token from its text.
    #[must_use]
    pub fn of(text: &str) -> Self {
        Self(text.to_owned())
    }

    /// Returns the text that the Global Discovery Server compares.
    #[must_use]
    pub fn secret(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(..)")
    }
}

impl fmt::Display for Invitation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.url)?;
        if let Some(fingerprint) = &self.fingerprint {
            write!(f, ",{FINGERPRINT}={fingerprint}")?;
        }
        if let Some(token) = &self.token {
            write!(f, ",{TOKEN}={token}")?;
        }
        Ok(())
    }
}

/// An error in an invitation. The message contains no part of the text.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvitationFault {
    /// The URL is invalid.
    #[error(
        "--gds begins with a URL that cannot be read; give opc.tcp://HOST:PORT, or the invitation that `ua-gds invite` printed"
    )]
    Url,
    /// The fingerprint is invalid.
    #[error(
        "--gds has a fingerprint that cannot be read: sha256= is followed by 64 hexadecimal digits"
    )]
    Fingerprint,
    /// The token is invalid.
    #[error(
        "--gds has a token that cannot be read: paste the invitation as `ua-gds invite` printed it"
    )]
    Token,
    /// An unknown part.
    #[error("--gds has a part that is neither sha256= nor token=; parts are separated by commas")]
    Part,
    /// The invitation has a token and no fingerprint, so any server could receive the token.
    #[error(
        "--gds has a token without sha256=: give the fingerprint of the server too, because the token is \
         sent only to a server with this certificate"
    )]
    Unpinned,
    /// The file cannot be read.
    #[error("--gds @FILE: the file cannot be read: {0}")]
    File(String),
}

impl FromStr for Invitation {
    type Err = InvitationFault;

    fn from_str(text: &str) -> Result<Self, InvitationFault> {
        let mut parts = text.split(',');
        let url = parts.next().unwrap_or_default();
        url.parse::<EndpointUrl>()
            .map_err(|_| InvitationFault::Url)?;
        let mut invitation = Self {
            url: url.to_owned(),
            fingerprint: None,
            token: None,
        };
        for part in parts {
            match part.split_once('=') {
                Some((FINGERPRINT, digits)) => {
                    let read = digits.parse().map_err(|_| InvitationFault::Fingerprint)?;
                    invitation.fingerprint = Some(read);
                }
                Some((TOKEN, token)) => {
                    let is_token = token
                        .bytes()
                        .all(|one| one.is_ascii_alphanumeric() || one == b'-');
                    if token.is_empty() || token.len() > LONGEST_TOKEN || !is_token {
                        return Err(InvitationFault::Token);
                    }
                    invitation.token = Some(Token::of(token));
                }
                _ => return Err(InvitationFault::Part),
            }
        }
        if invitation.token.is_some() && invitation.fingerprint.is_none() {
            return Err(InvitationFault::Unpinned);
        }
        Ok(invitation)
    }
}

const FINGERPRINT: &str = "sha256";
const TOKEN: &str = "token";
/// Largest file with an invitation, in bytes.
const LONGEST: u64 = 4096;
const LONGEST_TOKEN: usize = 128;

#[cfg(test)]
mod tests {
    use super::*;

    fn full() -> String {
        let fingerprint = Fingerprint::of(b"certificate");
        format!("opc.tcp://10.80.0.1:4841,sha256={fingerprint},token=3f9a-5ec2e7")
    }

    #[test]
    fn an_invitation_is_read_as_it_is_written() {
        let read: Invitation = full().parse().unwrap();
        assert_eq!(read.url, "opc.tcp://10.80.0.1:4841");
        assert_eq!(read.token, Some(Token::of("3f9a-5ec2e7")));
        assert_eq!(read.to_string(), full());
        let plain: Invitation = "opc.tcp://[fd00::1]:4841".parse().unwrap();
        assert_eq!((plain.fingerprint, plain.token), (None, None));
    }

    #[test]
    fn a_text_that_is_no_invitation_is_refused_without_being_repeated() {
        let short = full().replace(",token", "0,token");
        let cases = [
            ("gds:5ec2e7", InvitationFault::Url),
            (&short, InvitationFault::Fingerprint),
            (
                &full().replace("3f9a-5ec2e7", "5ec2e7 &"),
                InvitationFault::Token,
            ),
            (&full().replace("token", "tokn"), InvitationFault::Part),
            ("opc.tcp://gds:4841,token=5ec2e7", InvitationFault::Unpinned),
        ];
        for (text, wanted) in cases {
            let fault = text.parse::<Invitation>().unwrap_err();
            assert_eq!(fault, wanted, "{text}");
            assert!(!fault.to_string().contains("5ec2e7"), "{fault}");
        }
    }

    #[test]
    fn nothing_that_is_logged_shows_the_token() {
        let option: GdsOption = full().parse().unwrap();
        let read = option.read().unwrap();
        let shown = format!("{option:?} {read:?}");
        assert!(!shown.contains("5ec2e7"), "{shown}");
    }

    #[test]
    fn an_invitation_is_read_from_a_file() {
        let file = std::env::temp_dir().join(format!("plant-invitation-{}", std::process::id()));
        fs::write(&file, format!("{}\n", full())).unwrap();
        let option: GdsOption = format!("@{}", file.display()).parse().unwrap();
        assert_eq!(option.read().unwrap().to_string(), full());
        fs::remove_file(&file).unwrap();
        assert!(matches!(option.read(), Err(InvitationFault::File(_))));
    }
}

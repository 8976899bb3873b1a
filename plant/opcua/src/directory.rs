//! The Directory of a Global Discovery Server (OPC 10000-12, 6 and 7.9): the structure of an
//! application record, and a client that registers an application, requests its certificates and
//! reads its trust list.

use std::sync::{Arc, LazyLock};

use opcua::types::{
    ApplicationType, BinaryDecodable, BinaryEncodable, ByteString, ContextOwned,
    ExpandedMessageInfo, ExpandedNodeId, ExtensionObject, LocalizedText, MethodId, NodeId,
    ServerOnNetwork, StaticTypeLoader, TrustListDataType, TypeLoaderInstance, UAString, UaNullable,
    Variant, XmlDecodable, XmlEncodable, XmlType, binary_decode_to_enc,
};
use trust::{Certificate, CertificateSigningRequest, Crl};

use crate::client::{Browse, CallError, ClientError, OpcUaClient};
use crate::file::LARGEST;

/// The namespace of the Directory.
pub const NAMESPACE: &str = "http://opcfoundation.org/UA/GDS/";

/// ApplicationRecordDataType.
#[derive(
    Debug,
    Clone,
    PartialEq,
    Default,
    BinaryEncodable,
    BinaryDecodable,
    XmlEncodable,
    XmlDecodable,
    XmlType,
    UaNullable,
)]
pub struct ApplicationRecord {
    /// The ApplicationId; null for an application that is not registered.
    pub application_id: NodeId,
    /// The ApplicationUri.
    pub application_uri: UAString,
    /// Server, client, or both.
    pub application_type: ApplicationType,
    /// The application names.
    pub application_names: Option<Vec<LocalizedText>>,
    /// The ProductUri.
    pub product_uri: UAString,
    /// The DiscoveryUrls.
    pub discovery_urls: Option<Vec<UAString>>,
    /// Server capabilities such as `DA`; at least one for a server.
    pub server_capabilities: Option<Vec<UAString>>,
}

impl ApplicationRecord {
    /// Compares all but the ApplicationId and the locales of the names.
    fn says_the_same(&self, other: &Self) -> bool {
        let names = |one: &Self| -> Vec<UAString> {
            let names = one.application_names.iter().flatten();
            names.map(|name| name.text.clone()).collect()
        };
        self.application_uri == other.application_uri
            && self.application_type == other.application_type
            && names(self) == names(other)
            && self.product_uri.as_ref() == other.product_uri.as_ref()
            && self.discovery_urls == other.discovery_urls
            && self.server_capabilities == other.server_capabilities
    }
}

impl ExpandedMessageInfo for ApplicationRecord {
    fn full_type_id(&self) -> ExpandedNodeId {
        ExpandedNodeId::new_with_namespace(NAMESPACE, BINARY)
    }

    fn full_json_type_id(&self) -> ExpandedNodeId {
        ExpandedNodeId::new_with_namespace(NAMESPACE, JSON)
    }

    fn full_xml_type_id(&self) -> ExpandedNodeId {
        ExpandedNodeId::new_with_namespace(NAMESPACE, XML)
    }

    fn full_data_type_id(&self) -> ExpandedNodeId {
        ExpandedNodeId::new_with_namespace(NAMESPACE, DATA_TYPE)
    }
}

/// Decodes application records that clients send.
pub struct RecordTypes;

impl StaticTypeLoader for RecordTypes {
    fn instance() -> &'static TypeLoaderInstance {
        static TYPES: LazyLock<TypeLoaderInstance> = LazyLock::new(|| {
            let mut types = TypeLoaderInstance::new();
            types.add_binary_type(DATA_TYPE, BINARY, binary_decode_to_enc::<ApplicationRecord>);
            types
        });
        &TYPES
    }

    fn namespace() -> &'static str {
        NAMESPACE
    }
}

/// An error of a Directory request.
#[derive(Debug, thiserror::Error)]
pub enum DirectoryError {
    /// The client is not connected.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The Directory refuses the call or does not answer.
    #[error("{method}: {error}")]
    Call {
        /// The name of the method.
        method: &'static str,
        /// The error of the call.
        error: CallError,
    },
    /// The server has no Directory.
    #[error("the server has no namespace {NAMESPACE}, so it is not a Global Discovery Server")]
    None,
    /// The response does not conform to the standard.
    #[error("the response to {0} does not follow OPC 10000-12")]
    Answer(&'static str),
}

/// The Directory of a connected server.
#[derive(Clone)]
pub struct Directory {
    client: OpcUaClient,
    namespace: u16,
}

impl Directory {
    /// Returns the Directory of a connected client's server.
    ///
    /// # Errors
    /// Returns an error if the client is not connected or the server has no Directory.
    pub fn of(client: &OpcUaClient) -> Result<Self, DirectoryError> {
        client.knows(Arc::new(RecordTypes))?;
        let namespace = client.namespace(NAMESPACE);
        Ok(Self {
            client: client.clone(),
            namespace: namespace.ok_or(DirectoryError::None)?,
        })
    }

    async fn call(
        &self,
        (number, method): (u32, &'static str),
        arguments: Vec<Variant>,
    ) -> Result<Vec<Variant>, DirectoryError> {
        let [object, node] = [DIRECTORY, number].map(|number| NodeId::new(self.namespace, number));
        let called = self.client.call(&object, &node, arguments).await;
        called.map_err(|error| DirectoryError::Call { method, error })
    }

    /// Returns the ApplicationId of an application. An unknown application is registered, and a
    /// different record is updated.
    ///
    /// # Errors
    /// Returns an error if a call fails.
    pub async fn registered(&self, record: &ApplicationRecord) -> Result<NodeId, DirectoryError> {
        let uri = Variant::String(record.application_uri.clone());
        let found = self.call(FIND_APPLICATIONS, vec![uri]).await?;
        let Some(Variant::Array(found)) = found.into_iter().next() else {
            return Err(DirectoryError::Answer("FindApplications"));
        };
        let known = found.values.into_iter().find_map(|one| {
            let Variant::ExtensionObject(object) = one else {
                return None;
            };
            object.into_inner_as::<ApplicationRecord>()
        });
        if let Some(known) = known {
            let wanted = ApplicationRecord {
                application_id: known.application_id.clone(),
                ..record.clone()
            };
            if known.says_the_same(&wanted) {
                return Ok(wanted.application_id);
            }
            let updated = Variant::from(ExtensionObject::from_message(wanted));
            // UpdateApplication fails if the Directory does not know the certificate of this
            // application yet. The application is then registered again.
            if self.call(UPDATE_APPLICATION, vec![updated]).await.is_ok() {
                return Ok(known.application_id.clone());
            }
        }
        let record = Variant::from(ExtensionObject::from_message(record.clone()));
        let registered = self.call(REGISTER_APPLICATION, vec![record]).await?;
        match registered.into_iter().next() {
            Some(Variant::NodeId(id)) => Ok(*id),
            _ => Err(DirectoryError::Answer("RegisterApplication")),
        }
    }

    /// Returns the servers whose names match a pattern, up to a limit: QueryServers (OPC 10000-12,
    /// 6.6.11). `%` stands for any text and `_` for any character.
    ///
    /// # Errors
    /// Returns an error if a call fails.
    pub async fn servers(
        &self,
        pattern: &str,
        most: usize,
    ) -> Result<Vec<ServerOnNetwork>, DirectoryError> {
        let mut found = Vec::new();
        let mut after = 0;
        loop {
            let arguments = vec![
                Variant::UInt32(after),
                Variant::UInt32(PAGE),
                Variant::String(pattern.into()),
                Variant::String(UAString::null()),
                Variant::String(UAString::null()),
                Variant::from(Vec::<UAString>::new()),
            ];
            let answer = self.call(QUERY_SERVERS, arguments).await?;
            let page = match answer.into_iter().nth(1) {
                Some(Variant::Array(page)) => page.values,
                // The server may send an empty list as null.
                Some(Variant::Empty) => Vec::new(),
                _ => return Err(DirectoryError::Answer("QueryServers")),
            };
            let mut last = after;
            for one in page {
                let Variant::ExtensionObject(object) = one else {
                    return Err(DirectoryError::Answer("QueryServers"));
                };
                let server = object.into_inner_as::<ServerOnNetwork>();
                let server = server.ok_or(DirectoryError::Answer("QueryServers"))?;
                last = last.max(server.record_id);
                found.push(*server);
            }
            // Only records with a larger number follow, so that the queries end.
            if last == after || found.len() >= most {
                found.truncate(most);
                return Ok(found);
            }
            after = last;
        }
    }

    /// Requests a certificate, and returns the number of the request.
    ///
    /// # Errors
    /// The server refuses the request.
    pub async fn requested(
        &self,
        application: &NodeId,
        request: &CertificateSigningRequest,
    ) -> Result<NodeId, DirectoryError> {
        let any = NodeId::null();
        let request = Variant::ByteString(ByteString::from(request.der().to_vec()));
        let arguments = vec![
            Variant::from(application.clone()),
            Variant::from(any.clone()),
            Variant::from(any),
            request,
        ];
        let number = self.call(START_SIGNING_REQUEST, arguments).await?;
        match number.into_iter().next() {
            Some(Variant::NodeId(number)) => Ok(*number),
            _ => Err(DirectoryError::Answer("StartSigningRequest")),
        }
    }

    /// Returns the certificate that an authority issued for a request, and its issuer certificates.
    ///
    /// # Errors
    /// Returns an error if no certificate was issued; BadRequestNotComplete if the decision is
    /// pending.
    pub async fn finished(
        &self,
        application: &NodeId,
        number: &NodeId,
    ) -> Result<(Certificate, Vec<Certificate>), DirectoryError> {
        let arguments = vec![
            Variant::from(application.clone()),
            Variant::from(number.clone()),
        ];
        let finished = self.call(FINISH_REQUEST, arguments).await?;
        let odd = || DirectoryError::Answer("FinishRequest");
        let certificate = finished.first().and_then(certificate).ok_or_else(odd)?;
        let above = match finished.get(2) {
            Some(Variant::Array(all)) => all.values.iter().filter_map(self::certificate).collect(),
            _ => Vec::new(),
        };
        Ok((certificate, above))
    }

    /// Returns the trust list of an application.
    ///
    /// # Errors
    /// The list cannot be read.
    pub async fn trust_lists(&self, application: &NodeId) -> Result<TrustLists, DirectoryError> {
        let arguments = vec![
            Variant::from(application.clone()),
            Variant::from(NodeId::null()),
        ];
        let list = self.call(GET_TRUST_LIST, arguments).await?;
        let Some(Variant::NodeId(list)) = list.into_iter().next() else {
            return Err(DirectoryError::Answer("GetTrustList"));
        };
        let bytes = self.file(&list).await?;
        let context = ContextOwned::default();
        let read = TrustListDataType::decode(&mut bytes.as_slice(), &context.context());
        let read = read.map_err(|_| DirectoryError::Answer("the trust list"))?;
        let certificates = |all: Option<Vec<ByteString>>| {
            let each = all.into_iter().flatten().filter_map(|bytes| bytes.value);
            each.filter_map(|bytes| Certificate::read(&bytes).ok())
                .collect()
        };
        let lists = read.trusted_crls.into_iter().chain(read.issuer_crls);
        let each = lists.flatten().filter_map(|bytes| bytes.value);
        Ok(TrustLists {
            trusted: certificates(read.trusted_certificates),
            issuers: certificates(read.issuer_certificates),
            revocation_lists: each.filter_map(|bytes| Crl::read(&bytes).ok()).collect(),
        })
    }

    /// Reads the content of a file object, and closes the file (OPC 10000-20, 4.2).
    async fn file(&self, file: &NodeId) -> Result<Vec<u8>, DirectoryError> {
        // A file object may have its own method nodes.
        let below = self.client.browse(file, Browse::hierarchical()).await?;
        let call = async |of_type: MethodId, name: &'static str, arguments: Vec<Variant>| {
            let own = below
                .iter()
                .find(|one| one.browse_name.name.as_ref() == name);
            let method = own.map_or_else(|| of_type.into(), |one| one.node_id.node_id.clone());
            let called = self.client.call(file, &method, arguments).await;
            called.map_err(|error| DirectoryError::Call {
                method: name,
                error,
            })
        };
        let opened = call(MethodId::FileType_Open, "Open", vec![Variant::Byte(READ)]).await?;
        let Some(Variant::UInt32(handle)) = opened.into_iter().next() else {
            return Err(DirectoryError::Answer("Open"));
        };
        let mut content = Vec::new();
        let read = loop {
            let arguments = vec![Variant::UInt32(handle), Variant::Int32(AT_ONCE)];
            let read = call(MethodId::FileType_Read, "Read", arguments).await;
            let bytes = match read.map(|answer| answer.into_iter().next()) {
                Ok(Some(Variant::ByteString(bytes))) => bytes.value.unwrap_or_default(),
                Ok(_) => break Err(DirectoryError::Answer("Read")),
                Err(error) => break Err(error),
            };
            if bytes.is_empty() {
                break Ok(());
            }
            content.extend(bytes);
            if content.len() > LARGEST {
                break Err(DirectoryError::Answer("the file is too large"));
            }
        };
        let closed = call(
            MethodId::FileType_Close,
            "Close",
            vec![Variant::UInt32(handle)],
        );
        read.and(closed.await.map(drop))?;
        Ok(content)
    }
}

/// The trust list of an application (OPC 10000-12, 7.8.2.7).
#[derive(Debug, Clone, Default)]
pub struct TrustLists {
    /// Trusted certificates: of applications, and of authorities together with all certificates
    /// that they issue.
    pub trusted: Vec<Certificate>,
    /// Issuer certificates, which complete chains.
    pub issuers: Vec<Certificate>,
    /// Revocation lists of the trusted and of the issuer certificates.
    pub revocation_lists: Vec<Crl>,
}

fn certificate(bytes: &Variant) -> Option<Certificate> {
    let Variant::ByteString(bytes) = bytes else {
        return None;
    };
    Certificate::read(bytes.value.as_deref()?).ok()
}

/// Numeric NodeIds of the Directory object and its methods, the same at every Global Discovery
/// Server.
const DIRECTORY: u32 = 141;
const FIND_APPLICATIONS: (u32, &str) = (143, "FindApplications");
const REGISTER_APPLICATION: (u32, &str) = (146, "RegisterApplication");
const UPDATE_APPLICATION: (u32, &str) = (200, "UpdateApplication");
const QUERY_SERVERS: (u32, &str) = (151, "QueryServers");
const START_SIGNING_REQUEST: (u32, &str) = (157, "StartSigningRequest");
const FINISH_REQUEST: (u32, &str) = (163, "FinishRequest");
const GET_TRUST_LIST: (u32, &str) = (204, "GetTrustList");
/// Number of servers per QueryServers call.
const PAGE: u32 = 100;
/// The open mode for reading.
const READ: u8 = 1;
/// Bytes per Read call.
const AT_ONCE: i32 = 16 * 1024;
const DATA_TYPE: u32 = 1;
const BINARY: u32 = 134;
const XML: u32 = 127;
const JSON: u32 = 8001;

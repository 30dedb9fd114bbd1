//! Which server, with which token, trusted by whom: out of options, environment and context.

use std::fmt;
use std::net::IpAddr;
use std::path::PathBuf;

use blaze_runtime::environment;
use reqwest::Url;

use super::contexts::{self, Context};
use super::files::small;
use super::options::ServerOptions;
use crate::admin::closest;
use crate::exit::CliError;

/// Where nothing else is said.
const DEFAULT_SERVER: &str = "http://127.0.0.1:8080";
/// Longest token, in bytes.
const MAX_TOKEN_BYTES: usize = 8 * 1024;

/// What surrounds the process: variables that count, and the file of contexts.
#[derive(Default, Clone)]
pub(crate) struct Surroundings {
    pub(crate) server: Option<String>,
    pub(crate) token_file: Option<PathBuf>,
    pub(crate) token: Option<Token>,
    pub(crate) client_cert: Option<PathBuf>,
    pub(crate) client_key: Option<PathBuf>,
    pub(crate) contexts: Option<PathBuf>,
}

impl Surroundings {
    pub(crate) fn of_process() -> Self {
        Self {
            server: environment::variable("BLAZE_SERVER"),
            token_file: environment::variable("BLAZE_TOKEN_FILE").map(PathBuf::from),
            token: environment::variable("BLAZE_TOKEN").map(Token),
            client_cert: environment::variable("BLAZE_CLIENT_CERT").map(PathBuf::from),
            client_key: environment::variable("BLAZE_CLIENT_KEY").map(PathBuf::from),
            contexts: contexts::default_file(),
        }
    }
}

/// A token; never shown.
#[derive(Clone, PartialEq, Eq)]
pub(crate) struct Token(String);

impl Token {
    /// Its text.
    pub(crate) fn text(&self) -> &str {
        &self.0
    }

    #[cfg(test)]
    pub(crate) fn of(text: &str) -> Self {
        Self(text.to_owned())
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

/// Where the token comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum TokenSource {
    /// A file, read anew for each request: a token that is renewed there is used from then on.
    File(PathBuf),
    /// `BLAZE_TOKEN`.
    Variable(Token),
}

impl TokenSource {
    /// Reads it.
    ///
    /// # Errors
    /// [`CliError::Failed`] when the file cannot be read, [`CliError::Invalid`] for what is no
    /// token. Neither shows it.
    pub(crate) fn read(&self) -> Result<Token, CliError> {
        let (text, place) = match self {
            Self::File(file) => {
                let place = file.display().to_string();
                let content = small(file, "the token file")?;
                (String::from_utf8(content).unwrap_or_default(), place)
            }
            Self::Variable(token) => (token.0.clone(), "BLAZE_TOKEN".to_owned()),
        };
        let text = text.trim();
        let visible = text.bytes().all(|byte| byte.is_ascii_graphic());
        if text.is_empty() || text.len() > MAX_TOKEN_BYTES || !visible {
            return Err(CliError::Invalid(format!(
                "{place} holds no token: one line of up to {MAX_TOKEN_BYTES} visible ASCII \
                 characters"
            )));
        }
        Ok(Token(text.to_owned()))
    }
}

/// A certificate that is shown to a server that asks for one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ClientCertificate {
    /// The certificate, and what leads from it to its authority.
    pub(crate) cert_file: PathBuf,
    /// Its private key; `None`: the file of the certificate holds it.
    pub(crate) key_file: Option<PathBuf>,
}

/// A server and how to speak with it.
#[derive(Debug, Clone)]
pub(crate) struct Endpoint {
    /// Scheme, host and port.
    pub(crate) url: Url,
    /// Authorities that may sign its certificate.
    pub(crate) ca_file: Option<PathBuf>,
    /// Which certificate is shown to it if it asks for one.
    pub(crate) client_certificate: Option<ClientCertificate>,
    /// The token, if there is one.
    pub(crate) token: Option<TokenSource>,
}

impl Endpoint {
    /// A server to which neither certificate nor token is shown.
    pub(crate) fn at(url: Url) -> Self {
        Self { url, ca_file: None, client_certificate: None, token: None }
    }

    /// The server as people write it.
    pub(crate) fn server(&self) -> &str {
        self.url.as_str().trim_end_matches('/')
    }

    /// Whether the way there is encrypted.
    pub(crate) fn is_tls(&self) -> bool {
        self.url.scheme() == "https"
    }
}

/// Puts together what options, environment and context say, each part from the first that has it.
///
/// A context's token, authorities and certificate belong to its server: they go to another one only
/// where the context is named on the command line.
///
/// # Errors
/// [`CliError::Usage`] for an unknown context, a bad URL, a key without its certificate, or a token
/// that would go in clear over a network; [`CliError::Invalid`] for a bad file of contexts.
pub(crate) fn resolve(
    options: &ServerOptions,
    around: &Surroundings,
) -> Result<Endpoint, CliError> {
    let endpoint = choose(options, around)?;
    let url = &endpoint.url;
    if endpoint.token.is_some() && !endpoint.is_tls() && !is_loopback(url) {
        return Err(CliError::Usage(format!(
            "the token would go in clear to {url}: whoever sees the network could use it.\n  Use \
             https:// (with --ca-file for an authority of your own), or a tunnel that ends on this \
             machine: http://127.0.0.1:PORT."
        )));
    }
    Ok(endpoint)
}

/// As [`resolve`], for who only wants to look: the token may not be sent there.
///
/// # Errors
/// As [`resolve`], but not for a token that would go in clear.
pub(crate) fn choose(options: &ServerOptions, around: &Surroundings) -> Result<Endpoint, CliError> {
    let context = chosen_context(options, around)?;
    let named = options.server.as_deref().or(around.server.as_deref());
    let own_server = context.as_ref().map(|context| context.server.as_str());
    let url =
        parse_server(named.or(own_server).unwrap_or(DEFAULT_SERVER)).map_err(CliError::Usage)?;
    let belongs = options.context.is_some()
        || own_server.is_some_and(|own| parse_server(own).as_ref() == Ok(&url));
    let context = context.filter(|_| belongs);
    let token = options
        .token_file
        .clone()
        .or_else(|| around.token_file.clone())
        .map(TokenSource::File)
        .or_else(|| around.token.clone().map(TokenSource::Variable))
        .or_else(|| context.as_ref()?.token_file.clone().map(TokenSource::File));
    let client_certificate =
        own_certificate(options, around)?.or_else(|| of_context(context.as_ref()?));
    let ca_file = options.ca_file.clone().or_else(|| context?.ca_file);
    Ok(Endpoint { url, ca_file, client_certificate, token })
}

/// The certificate that options or environment name. Certificate and key come from the same of
/// them: they are a pair.
fn own_certificate(
    options: &ServerOptions,
    around: &Surroundings,
) -> Result<Option<ClientCertificate>, CliError> {
    let pair = |cert_file: &PathBuf, key_file: &Option<PathBuf>| {
        Some(ClientCertificate { cert_file: cert_file.clone(), key_file: key_file.clone() })
    };
    match (&options.client_cert, &around.client_cert, &around.client_key) {
        (Some(cert_file), _, _) => Ok(pair(cert_file, &options.client_key)),
        (None, Some(cert_file), _) => Ok(pair(cert_file, &around.client_key)),
        (None, None, Some(_)) => Err(CliError::Usage(
            "BLAZE_CLIENT_KEY is set, BLAZE_CLIENT_CERT is not: a key goes with its certificate"
                .to_owned(),
        )),
        (None, None, None) => Ok(None),
    }
}

fn of_context(context: &Context) -> Option<ClientCertificate> {
    Some(ClientCertificate {
        cert_file: context.client_cert.clone()?,
        key_file: context.client_key.clone(),
    })
}

fn chosen_context(
    options: &ServerOptions,
    around: &Surroundings,
) -> Result<Option<Context>, CliError> {
    let Some(file) = &around.contexts else {
        return match &options.context {
            Some(name) => Err(CliError::Usage(format!(
                "there is no context {name}: neither XDG_CONFIG_HOME nor HOME is set"
            ))),
            None => Ok(None),
        };
    };
    let mut known = contexts::load(file)?;
    let Some(name) = options.context.as_ref().or(known.current.as_ref()).cloned() else {
        return Ok(None);
    };
    match known.contexts.remove(&name) {
        Some(context) => Ok(Some(context)),
        None => Err(CliError::Usage(unknown_context(&name, known.contexts.keys()))),
    }
}

/// What is said of a context that does not exist.
pub(crate) fn unknown_context<'a>(name: &str, known: impl Iterator<Item = &'a String>) -> String {
    let meant = closest(name, known.map(String::as_str))
        .map_or_else(String::new, |meant| format!("; did you mean {meant}?"));
    format!(
        "there is no context {name}{meant}\n  `blaze context list` shows all, `blaze context add` \
         makes one."
    )
}

/// Reads the URL of a server: scheme, host and perhaps port, nothing else.
///
/// # Errors
/// In words, with what may have been meant. The text is not repeated where it holds a password.
pub(crate) fn parse_server(text: &str) -> Result<Url, String> {
    let meant = || format!("http://{text} (or https)");
    if !text.contains("://") {
        return Err(format!("{text:?} is no URL of a server; did you mean {}?", meant()));
    }
    let url = Url::parse(text).map_err(|error| format!("the URL of the server: {error}"))?;
    if !url.username().is_empty() || url.password().is_some() {
        return Err("the URL of the server holds a user or password; give a token by --token-file"
            .to_owned());
    }
    if !matches!(url.scheme(), "http" | "https") || url.host_str().is_none_or(str::is_empty) {
        return Err(format!(
            "{text:?} is no URL of a server: http://HOST:PORT or https://HOST:PORT"
        ));
    }
    if !matches!(url.path(), "" | "/") || url.query().is_some() || url.fragment().is_some() {
        return Err(format!(
            "{text:?}: give scheme, host and port alone; the path {} is added by the commands",
            super::kinds::BASE
        ));
    }
    Ok(url)
}

/// Whether what is sent to a URL stays on this machine.
pub(crate) fn is_loopback(url: &Url) -> bool {
    let host = url.host_str().unwrap_or_default();
    let bare = host.trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || bare.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::contexts::Contexts;

    fn around(directory: &std::path::Path) -> Surroundings {
        let file = directory.join("config.yaml");
        contexts::update(&file, |contexts: &mut Contexts| {
            for name in ["lab", "hall"] {
                let context = Context {
                    server: format!("https://{name}.example"),
                    token_file: Some(directory.join(name)),
                    ca_file: Some(PathBuf::from("/ca.pem")),
                    client_cert: Some(PathBuf::from("/client.pem")),
                    client_key: None,
                };
                contexts.contexts.insert(name.to_owned(), context);
            }
            contexts.current = Some("lab".to_owned());
            Ok(())
        })
        .unwrap();
        Surroundings { contexts: Some(file), ..Surroundings::default() }
    }

    #[test]
    fn the_server_comes_from_the_first_that_names_one() {
        let directory = tempfile::tempdir().unwrap();
        let mut around = around(directory.path());
        let mut options = ServerOptions::default();
        let server = |options: &ServerOptions, around: &Surroundings| {
            resolve(options, around).unwrap().server().to_owned()
        };
        assert_eq!(server(&options, &Surroundings::default()), DEFAULT_SERVER);
        assert_eq!(server(&options, &around), "https://lab.example");
        options.context = Some("hall".to_owned());
        assert_eq!(server(&options, &around), "https://hall.example");
        around.server = Some("https://variable.example".to_owned());
        assert_eq!(server(&options, &around), "https://variable.example");
        options.server = Some("http://127.0.0.1:1".to_owned());
        assert_eq!(server(&options, &around), "http://127.0.0.1:1");
    }

    #[test]
    fn the_token_comes_from_the_first_that_has_one() {
        let directory = tempfile::tempdir().unwrap();
        let mut around = around(directory.path());
        let mut options = ServerOptions::default();
        let token = |options: &ServerOptions, around: &Surroundings| {
            resolve(options, around).unwrap().token
        };
        assert_eq!(token(&options, &Surroundings::default()), None);
        let file = |name: &str| Some(TokenSource::File(directory.path().join(name)));
        assert_eq!(token(&options, &around), file("lab"));
        around.token = Some(Token::of("abc"));
        assert_eq!(token(&options, &around), Some(TokenSource::Variable(Token::of("abc"))));
        around.token_file = Some(directory.path().join("variable"));
        assert_eq!(token(&options, &around), file("variable"));
        options.token_file = Some(directory.path().join("option"));
        assert_eq!(token(&options, &around), file("option"));
    }

    #[test]
    fn certificate_and_key_come_as_a_pair_from_the_first_that_has_one() {
        let directory = tempfile::tempdir().unwrap();
        let mut around = around(directory.path());
        let mut options = ServerOptions::default();
        let shown = |options: &ServerOptions, around: &Surroundings| {
            resolve(options, around).unwrap().client_certificate
        };
        let pair = |cert_file: &str, key_file: Option<&str>| {
            Some(ClientCertificate {
                cert_file: PathBuf::from(cert_file),
                key_file: key_file.map(PathBuf::from),
            })
        };
        assert_eq!(shown(&options, &Surroundings::default()), None);
        assert_eq!(shown(&options, &around), pair("/client.pem", None));
        around.client_cert = Some(PathBuf::from("/variable.pem"));
        around.client_key = Some(PathBuf::from("/variable.key"));
        assert_eq!(shown(&options, &around), pair("/variable.pem", Some("/variable.key")));
        // A certificate without a key of its own is not put together with another one's.
        options.client_cert = Some(PathBuf::from("/option.pem"));
        assert_eq!(shown(&options, &around), pair("/option.pem", None));
        options.client_key = Some(PathBuf::from("/option.key"));
        assert_eq!(shown(&options, &around), pair("/option.pem", Some("/option.key")));
        let alone = Surroundings {
            client_key: Some(PathBuf::from("/variable.key")),
            ..Surroundings::default()
        };
        let error = resolve(&ServerOptions::default(), &alone).unwrap_err();
        assert!(matches!(error, CliError::Usage(_)), "{error}");
    }

    #[test]
    fn a_contexts_token_does_not_go_elsewhere_by_itself() {
        let directory = tempfile::tempdir().unwrap();
        let around = around(directory.path());
        let mut options = ServerOptions {
            server: Some("https://other.example".to_owned()),
            ..ServerOptions::default()
        };
        let endpoint = resolve(&options, &around).unwrap();
        assert_eq!((endpoint.token, endpoint.ca_file), (None, None));
        assert_eq!(endpoint.client_certificate, None);
        options.server = Some("https://lab.example:443/".to_owned());
        assert!(resolve(&options, &around).unwrap().token.is_some());
        options.server = Some("https://127.0.0.1:9443".to_owned());
        options.context = Some("lab".to_owned());
        assert!(resolve(&options, &around).unwrap().token.is_some());
    }

    #[test]
    fn a_token_never_goes_in_clear_over_a_network() {
        let around = Surroundings { token: Some(Token::of("sesame")), ..Surroundings::default() };
        let with = |server: &str| {
            let options =
                ServerOptions { server: Some(server.to_owned()), ..ServerOptions::default() };
            resolve(&options, &around)
        };
        for good in
            ["http://127.0.0.1:1", "http://[::1]:1", "http://localhost", "https://robot.example"]
        {
            assert!(with(good).is_ok(), "{good}");
        }
        for bad in [
            "http://robot.example",
            "http://10.0.0.1:8080",
            "http://127.0.0.1.example",
            "http://[::2]",
        ] {
            let error = with(bad).unwrap_err();
            assert_eq!(error.exit() as u8, 2);
            let text = error.to_string();
            assert!(text.contains("https://") && !text.contains("sesame"), "{text}");
        }
    }

    #[test]
    fn urls_of_servers_are_checked() {
        for (bad, why) in [
            ("robot:8080", "did you mean http://robot:8080"),
            ("ftp://a", "http://HOST:PORT"),
            ("http://a/api/v1", "give scheme, host and port alone"),
            ("http://a?x=1", "give scheme, host and port alone"),
            ("https://me:secret@a", "--token-file"),
            ("http://", "URL of the server"),
        ] {
            let error = parse_server(bad).unwrap_err();
            assert!(error.contains(why) && !error.contains("secret"), "{bad}: {error}");
        }
    }

    #[test]
    fn unknown_contexts_get_a_suggestion() {
        let directory = tempfile::tempdir().unwrap();
        let options = ServerOptions { context: Some("hal".to_owned()), ..ServerOptions::default() };
        let error = resolve(&options, &around(directory.path())).unwrap_err();
        assert!(
            error.to_string().contains("there is no context hal; did you mean hall?\n  `blaze"),
            "{error}"
        );
    }

    #[test]
    fn token_files_are_read_anew_and_never_shown() {
        let directory = tempfile::tempdir().unwrap();
        let source = TokenSource::File(directory.path().join("token"));
        assert!(source.read().unwrap_err().to_string().contains("token"));
        std::fs::write(directory.path().join("token"), "abc.def\n").unwrap();
        assert_eq!(source.read().unwrap().text(), "abc.def");
        std::fs::write(directory.path().join("token"), "ghi").unwrap();
        assert_eq!(source.read().unwrap().text(), "ghi");
        std::fs::write(directory.path().join("token"), "two sesames").unwrap();
        let error = source.read().unwrap_err();
        assert!(!error.to_string().contains("sesames"), "{error}");
        assert_eq!(format!("{:?}", Token::of("sesame")), "Token(…)");
    }
}

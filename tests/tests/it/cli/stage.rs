//! Processes that are started and commands that are run.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use blaze_tests::process::{Process, binary};
use blaze_tests::wait;
use serde_json::{Value, json};
use tempfile::TempDir;

/// A start on a machine that does much else.
pub(crate) const START: Duration = Duration::from_secs(60);
/// What is waited for, at most.
pub(crate) const PATIENCE: Duration = Duration::from_secs(20);

/// What a command said, and how it ended.
#[derive(Debug)]
pub(crate) struct Said {
    pub(crate) code: i32,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Said {
    pub(crate) fn json(&self) -> Value {
        serde_json::from_str(&self.stdout).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }
}

/// A folder, and programs that run in it.
pub(crate) struct Stage {
    folder: TempDir,
}

impl Stage {
    pub(crate) fn new() -> Self {
        Self { folder: TempDir::new().unwrap() }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(crate) fn write(&self, name: &str, content: &str) -> PathBuf {
        let path = self.path(name);
        std::fs::write(&path, content).unwrap();
        path
    }

    /// Runs a program of the workspace in the folder until it ends.
    pub(crate) fn run(&self, program: &str, arguments: &[&str]) -> Said {
        let output = Command::new(binary(program).unwrap())
            .args(arguments)
            .current_dir(self.folder.path())
            .env_remove("BLAZE_SERVER")
            .env_remove("BLAZE_TOKEN")
            .env_remove("BLAZE_TOKEN_FILE")
            .env("XDG_CONFIG_HOME", self.folder.path())
            .stdin(Stdio::null())
            .output()
            .unwrap();
        Said {
            code: output.status.code().unwrap_or(-1),
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }

    /// `blaze` for a main service.
    pub(crate) fn blaze(&self, main: &Main, line: &str) -> Said {
        let server = format!("http://{}", main.rest);
        let mut arguments: Vec<&str> = line.split_whitespace().collect();
        arguments.extend(["--server", &server]);
        if let Some(token) = &main.token {
            arguments.extend(["--token-file", token.to_str().unwrap()]);
        }
        self.run("blaze", &arguments)
    }

    /// A main service without tokens.
    pub(crate) fn dev_main(&self) -> Main {
        let file = self.main_file(&json!({}));
        Main::start(&["--dev", "--config", file.to_str().unwrap()], None)
    }

    /// A main service that signs tokens, and one of an administrator.
    pub(crate) fn main_with_tokens(&self) -> Main {
        let key = self.path("jwt.key");
        let made = self
            .run("blaze", &["token", "keygen", "--alg", "HS256", "--out", key.to_str().unwrap()]);
        assert_eq!(made.code, 0, "{made:?}");
        let file = self
            .main_file(&json!({ "auth": { "keys": [ { "id": "k1", "alg": "HS256", "file": key,
                "sign": true } ] } }));
        let line = "token create --subject root --role admin --alg HS256 --key-id k1 --key-file";
        let words: Vec<&str> = line.split_whitespace().chain([key.to_str().unwrap()]).collect();
        let token = self.run("blaze", &words);
        assert_eq!(token.code, 0, "{token:?}");
        let token = self.write("admin.token", &token.stdout);
        Main::start(&["--config", file.to_str().unwrap()], Some(token))
    }

    fn main_file(&self, more: &Value) -> PathBuf {
        let mut section = json!({
            "rest": { "listen": "127.0.0.1:0" }, "grpc": { "listen": "127.0.0.1:0" },
            "admin": { "listen": "127.0.0.1:0" },
            "store": { "sqlite": { "path": self.path("main.db") } },
        });
        section.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        let file = json!({ "log": { "level": "warn" }, "control_plane": section });
        // JSON is YAML.
        self.write("main.yaml", &file.to_string())
    }
}

/// A main service that runs.
pub(crate) struct Main {
    /// It runs as long as this is held.
    _process: Process,
    pub(crate) rest: SocketAddr,
    pub(crate) grpc: SocketAddr,
    token: Option<PathBuf>,
}

impl Main {
    fn start(arguments: &[&str], token: Option<PathBuf>) -> Self {
        let process = Process::start("blaze-config", arguments, None).unwrap();
        let places = ready(&process);
        Self {
            _process: process,
            rest: places["rest"].parse().unwrap(),
            grpc: places["grpc"].parse().unwrap(),
            token,
        }
    }
}

/// What stands in the ready line of a process, once it has come.
pub(crate) fn ready(process: &Process) -> BTreeMap<String, String> {
    let line = wait::until_some(
        "the ready line",
        START,
        || process.stdout().into_iter().find(|line| line.starts_with("ready ")),
        || process.tail(),
    )
    .unwrap();
    let words = line.split(' ').filter_map(|word| word.split_once('='));
    words.map(|(name, place)| (name.to_owned(), place.to_owned())).collect()
}

/// Permissions of a file.
pub(crate) fn mode(path: &Path) -> u32 {
    use std::os::unix::fs::PermissionsExt as _;
    std::fs::metadata(path).unwrap().permissions().mode() & 0o777
}

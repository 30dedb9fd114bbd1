//! `blaze call`.

use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::{
    Broker, BrokerKind, Content, Publisher, PublisherOptions, SubscribeOptions, Subscription,
};
use blaze_domain::control::{
    Answer, CallMessage, Common, ControlMessage, MAX_CALL_TIMEOUT_MS, WithdrawMessage,
};
use blaze_domain::names::ChannelName;
use blaze_domain::{InstanceName, ServiceName, TopicName};
use blaze_runtime::config::Sources;
use bytes::Bytes;
use clap::Args;
use serde_json::{Map, Value};
use tokio::time::{Instant, timeout_at};

use super::{ANSWER_WITHIN, open, wait_until_up};
use crate::args::parse_topic;
use crate::config::text::parse_duration;
use crate::exit::{CliError, Exit};
use crate::node_file;
use crate::output::{self, Format};

/// Between two questions whether a flow is there.
const ASK_EVERY: Duration = Duration::from_millis(250);
/// How much longer than the flow the command waits.
const GRACE: Duration = Duration::from_secs(5);
/// Messages that are taken at once.
const BATCH: usize = 64;

/// Options of `blaze call`.
#[derive(Debug, Args)]
pub struct CallOptions {
    /// The service, for example add_two_ints
    #[arg(value_parser = parse_service)]
    pub name: TopicName,
    /// The request as a JSON object
    #[arg(value_name = "JSON", value_parser = parse_object)]
    pub request: Map<String, Value>,
    /// How long to wait for the reply, at most 10m
    #[arg(long, value_name = "TIME", default_value = "5s", value_parser = parse_timeout)]
    pub timeout: Duration,
    /// Node file that names the broker; else BLAZE_CONFIG, ./blaze.yaml, /etc/blaze/blaze.yaml
    #[arg(long, value_name = "FILE")]
    pub config: Option<std::path::PathBuf>,
}

/// A service, also as ROS 2 writes it.
fn parse_service(text: &str) -> Result<TopicName, String> {
    parse_topic(text.strip_prefix('/').unwrap_or(text))
}

fn parse_object(text: &str) -> Result<Map<String, Value>, String> {
    match serde_json::from_str(text) {
        Ok(Value::Object(object)) => Ok(object),
        Ok(_) => Err("a request is a JSON object, such as '{\"a\": 1}'".to_owned()),
        Err(error) => Err(format!("it is not JSON: {error}")),
    }
}

fn parse_timeout(text: &str) -> Result<Duration, String> {
    let timeout = parse_duration(text)?;
    let most = Duration::from_millis(MAX_CALL_TIMEOUT_MS.into());
    match timeout {
        timeout if timeout.as_millis() > 0 && timeout <= most => Ok(timeout),
        _ => Err("it is 1 ms to 10 minutes".to_owned()),
    }
}

/// Calls a service and prints its reply.
///
/// # Errors
/// [`CliError`]: no broker, no flow, or why there is no reply.
pub async fn run(options: CallOptions, format: Format) -> Result<Exit, CliError> {
    let sources = Sources::of_process(options.config.clone(), Vec::new());
    let file = node_file::read(&sources).map_err(CliError::Invalid)?;
    let (broker, _) = open(&file)?;
    wait_until_up(&broker).await?;
    let outcome = call(broker.as_ref(), &options).await;
    broker.close().await;
    let reply = outcome?;
    let text = output::format_object(&reply, format, |reply| {
        serde_json::to_string_pretty(reply).map_err(|error| CliError::Failed(error.to_string()))
    })?;
    output::print(&text)?;
    Ok(Exit::Done)
}

async fn call(broker: &dyn Broker, options: &CallOptions) -> Result<Value, CliError> {
    let fault =
        |what: &str, error: &dyn std::fmt::Display| CliError::Failed(format!("{what}: {error}"));
    let mut conversation = Conversation::start(broker).await?;
    let service: ServiceName = "blaze-call".parse().map_err(|error| fault("service", &error))?;
    let instance: InstanceName =
        format!("p{}", std::process::id()).parse().map_err(|error| fault("instance", &error))?;
    let common = Common {
        instance,
        reply_to: Some(conversation.reply_to.clone()),
        ..Common::new(options.name.clone(), service)
    };
    conversation.wait_for_flow(&common).await?;
    let timeout_ms = u32::try_from(options.timeout.as_millis()).unwrap_or(MAX_CALL_TIMEOUT_MS);
    let id = format!("{}-call", conversation.own);
    let common = Common { id: Some(id.clone()), ..common };
    let request = options.request.clone();
    let message = ControlMessage::Call(CallMessage { common, timeout_ms, request });
    // Once: whoever repeats it may have it executed twice.
    conversation.say(&message);
    let Some(answer) = conversation.answer(&id, options.timeout + GRACE).await? else {
        return Err(CliError::Failed(format!(
            "the flow took the call of {} and did not answer: whether it was executed is not known",
            options.name
        )));
    };
    match answer {
        Answer { error: Some(error), .. } => Err(CliError::Call(Box::new(error))),
        Answer { reply: Some(reply), ok: true, .. } => Ok(reply),
        _ => Err(CliError::Failed(
            "the flow answers without a reply: it is of a version that calls no services"
                .to_owned(),
        )),
    }
}

/// Control messages to the flow on a broker, and its answers.
struct Conversation {
    kind: BrokerKind,
    control: Arc<dyn Publisher>,
    answers: Subscription,
    reply_to: ChannelName,
    /// Begins the ids of this process: others may get their answers on the same channel.
    own: String,
}

impl Conversation {
    async fn start(broker: &dyn Broker) -> Result<Self, CliError> {
        let failed = |error: &dyn std::fmt::Display| CliError::Failed(error.to_string());
        let kind = broker.kind();
        let own = format!("blaze-call-{:016x}", rand::random::<u64>());
        let reply_to: ChannelName =
            format!("blaze/reply/{own}").parse().map_err(|error| failed(&error))?;
        // Where channels are made beforehand all answers share one.
        let shares = matches!(kind, BrokerKind::Kafka | BrokerKind::Dds);
        let channel = if shares { ChannelName::shared_reply() } else { reply_to.clone() };
        let subscribed = broker.subscribe(&channel, SubscribeOptions::default()).await;
        let answers = subscribed.map_err(|error| failed(&error))?;
        let options =
            PublisherOptions { reliable: kind == BrokerKind::Dds, ..PublisherOptions::default() };
        let control =
            broker.publisher(&ChannelName::control(), options).map_err(|error| failed(&error))?;
        Ok(Self { kind, control, answers, reply_to, own })
    }

    fn say(&self, message: &ControlMessage) {
        self.control.publish_bare(&Bytes::from(message.to_json().to_string()), None);
    }

    /// Gives back what was never leased, until that is answered: then calls arrive, too.
    async fn wait_for_flow(&mut self, common: &Common) -> Result<(), CliError> {
        let until = Instant::now() + ANSWER_WITHIN;
        let id = format!("{}-there", self.own);
        let common = Common { id: Some(id.clone()), ..common.clone() };
        let question = ControlMessage::Withdraw(WithdrawMessage { common, kind: None });
        while Instant::now() < until {
            self.say(&question);
            if self.answer(&id, ASK_EVERY).await?.is_some() {
                return Ok(());
            }
        }
        Err(CliError::NoBroker {
            kind: format!("flow on {}", self.kind),
            waited_s: ANSWER_WITHIN.as_secs(),
            detail: "is blaze-flow running on this broker? See its /readyz.".to_owned(),
        })
    }

    /// The answer to one message, if it comes in time.
    async fn answer(&mut self, id: &str, within: Duration) -> Result<Option<Answer>, CliError> {
        let until = Instant::now() + within;
        let mut batch = Vec::new();
        while let Ok(count) = timeout_at(until, self.answers.receive(&mut batch, BATCH)).await {
            if count == 0 {
                return Err(CliError::Failed("the broker was closed".to_owned()));
            }
            for received in batch.drain(..) {
                let Content::Bare { payload, .. } = received.content else { continue };
                let mut answers = Answer::read_all(&payload).into_iter();
                let found = answers.find(|answer| answer.id.as_deref() == Some(id));
                if found.is_some() {
                    return Ok(found);
                }
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::Command;
    use crate::args::tests::parse;
    use blaze_domain::control::{ControlError, ErrorCode};

    #[test]
    fn names_are_those_of_ros_and_requests_are_objects() {
        let Command::Call(options) =
            parse("call /add_two_ints {\"a\":1} --timeout 2s").unwrap().command
        else {
            panic!("another command")
        };
        assert_eq!((options.name.as_str(), options.timeout.as_secs()), ("add_two_ints", 2));
        assert_eq!(options.request["a"], 1);
        for (line, why) in [
            ("call add [1]", "JSON object"),
            ("call add {a}", "not JSON"),
            ("call add {} --timeout 0s", "10 minutes"),
            ("call add {} --timeout 11m", "10 minutes"),
        ] {
            let error = parse(line).unwrap_err();
            assert!(error.to_string().contains(why), "{line}: {error}");
        }
    }

    #[test]
    fn each_fault_has_the_exit_code_of_the_contract() {
        for (code, exit) in [
            (ErrorCode::NoServer, 4),
            (ErrorCode::ConvertError, 7),
            (ErrorCode::Timeout, 1),
            (ErrorCode::TypeUnknown, 1),
            (ErrorCode::AccessDenied, 1),
        ] {
            let error = CliError::Call(Box::new(ControlError::new(code, "/request/a", "detail")));
            assert_eq!(error.exit() as u8, exit, "{code}");
            assert_eq!(error.to_json()["code"], code.as_str());
        }
    }
}

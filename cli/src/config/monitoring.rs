//! What the main service knows from the monitors of all nodes: the fleet at a glance, problems, why
//! a topic does not arrive.

use std::collections::VecDeque;
use std::time::Duration;

use serde_json::Value;
use tokio::time::timeout;

use super::call::Call;
use super::client::{Client, reason};
use super::kinds::BASE;
use super::sse::Parser;
use crate::exit::CliError;

/// The first picture of a live view comes at once.
const SNAPSHOT_WITHIN: Duration = Duration::from_secs(10);
/// Periods that a live view may have, in ms.
const PERIOD_MS: (u64, u64) = (500, 10_000);

impl Client {
    /// All nodes at a glance: the first event of the live view. While it is asked again and again,
    /// monitors report every `period`.
    ///
    /// # Errors
    /// As [`Self::open`], and [`CliError::Foreign`] for a stream without a picture.
    pub(crate) async fn fleet(&self, period: Duration) -> Result<Value, CliError> {
        let period_ms = u64::try_from(period.as_millis()).unwrap_or(PERIOD_MS.1);
        let call = Call::get(format!("{BASE}/live"))
            .query("view", "fleet")
            .query("period_ms", period_ms.clamp(PERIOD_MS.0, PERIOD_MS.1).to_string());
        let late = || self.odd(format!("no picture within {} s", SNAPSHOT_WITHIN.as_secs()));
        timeout(SNAPSHOT_WITHIN, self.first_picture(&call)).await.map_err(|_| late())?
    }

    async fn first_picture(&self, call: &Call) -> Result<Value, CliError> {
        let (mut response, _) = self.open(call).await?;
        let (mut parser, mut events) = (Parser::default(), VecDeque::new());
        loop {
            let chunk = response.chunk().await.map_err(|error| self.odd(reason(&error)))?;
            let chunk = chunk.ok_or_else(|| self.odd("the live view ends without a picture"))?;
            parser.push(&chunk, &mut events).map_err(|error| self.odd(error.to_string()))?;
            if let Some(event) = events.drain(..).find(|event| event.name == "snapshot") {
                return serde_json::from_str(&event.data)
                    .map_err(|error| self.odd(format!("the picture is no JSON: {error}")));
            }
        }
    }

    /// Problems of all nodes and layers, worst first.
    ///
    /// # Errors
    /// As [`Self::send`], and [`CliError::Foreign`] for what is no list.
    pub(crate) async fn problems(&self) -> Result<Vec<Value>, CliError> {
        let mut body = self.send(&Call::get(format!("{BASE}/problems"))).await?.body;
        match body.get_mut("items").map(Value::take) {
            Some(Value::Array(items)) => Ok(items),
            _ => Err(self.odd("the problems are no list")),
        }
    }

    /// Why a topic does or does not arrive, by the flows of both ends.
    ///
    /// # Errors
    /// As [`Self::send`].
    pub(crate) async fn why(
        &self,
        topic: &str,
        to: Option<String>,
        from: Option<String>,
    ) -> Result<Value, CliError> {
        let call = Call::get(format!("{BASE}/why"))
            .query("topic", topic)
            .query_if("to", to)
            .query_if("from", from);
        Ok(self.send(&call).await?.body)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::stub::{Reply, Stub};
    use super::*;

    #[tokio::test]
    async fn the_picture_is_the_first_event_of_the_live_view() {
        let stub = Stub::start(|_, before| {
            Reply::Events(match before {
                0 => "retry: 2000\n\nevent: snapshot\ndata: {\"nodes\":{}}\n\n".to_owned(),
                _ => "retry: 2000\n\n".to_owned(),
            })
        })
        .await;
        let client = stub.client();
        let picture = client.fleet(Duration::from_secs(1)).await.unwrap();
        assert_eq!(picture, json!({"nodes": {}}));
        let error = client.fleet(Duration::from_millis(100)).await.unwrap_err();
        assert!(error.to_string().contains("without a picture"), "{error}");
        assert_eq!(
            stub.lines(),
            [
                "GET /api/v1/live?view=fleet&period_ms=1000",
                "GET /api/v1/live?view=fleet&period_ms=500"
            ]
        );
    }

    #[tokio::test]
    async fn problems_and_why_are_asked_by_their_names() {
        let stub = Stub::start(|asked, _| {
            Reply::json(&match asked.target.contains("/problems") {
                true => json!({"items": [{"code": "hot"}], "total": 1}),
                false => json!({"verdict": "flowing"}),
            })
        })
        .await;
        let client = stub.client();
        assert_eq!(client.problems().await.unwrap(), [json!({"code": "hot"})]);
        client.why("imu/data", Some("cloud".to_owned()), None).await.unwrap();
        assert_eq!(
            stub.lines(),
            ["GET /api/v1/problems", "GET /api/v1/why?topic=imu%2Fdata&to=cloud"]
        );
    }
}

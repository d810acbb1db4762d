"use strict";
// Sections come as HTML that the server escaped; this page adds nothing of its own to them.
const QUIET_MS = 5000;
const lost = document.getElementById("lost");
const answer = document.getElementById("answer");
const form = document.getElementById("approve");
let heard = Date.now();

function say(text, kind) {
  answer.textContent = text;
  answer.className = kind;
}

function candidate() {
  const found = document.querySelector("#candidate input[name=candidate]");
  return found ? found.value : "";
}

function take(sections) {
  const before = candidate();
  for (const [id, html] of Object.entries(sections)) {
    const place = document.getElementById(id);
    if (!place) continue;
    const open = place.querySelector("details[open]") !== null;
    place.innerHTML = html;
    if (open) place.querySelector("details")?.setAttribute("open", "");
  }
  if (form && before && candidate() && candidate() !== before) {
    form.reset();
    say("The candidate has changed: look at it again.", "refused");
  }
}

function look() {
  const quiet = Date.now() - heard;
  document.body.classList.toggle("lost", quiet > QUIET_MS);
  lost.hidden = quiet <= QUIET_MS;
  if (quiet > QUIET_MS) {
    const since = new Date(heard).toLocaleTimeString();
    lost.textContent = `Nothing comes from the vehicle since ${since}, for ` +
      `${Math.round(quiet / 1000)} s. No figure is shown until it does.`;
  }
}

const source = new EventSource("events");
source.addEventListener("message", (event) => {
  heard = Date.now();
  take(JSON.parse(event.data));
  look();
});
setInterval(look, 1000);

if (form) {
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const button = form.querySelector("button");
    button.disabled = true;
    say("asking the daemon …", "");
    try {
      const body = new URLSearchParams(new FormData(form));
      const reply = await fetch(form.action, {
        method: "POST", body, headers: { Accept: "application/json" },
      });
      const found = await reply.json();
      say(`${found.accepted ? "Accepted" : "Refused"}: ${found.text}`,
        found.accepted ? "accepted" : "refused");
    } catch {
      say("No answer came: look at the state above before you try again.", "refused");
    }
    form.reset();
    button.disabled = false;
  });
}

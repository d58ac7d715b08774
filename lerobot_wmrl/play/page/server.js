// The page's world model runs in a server, which keeps the drive: a page that was reloaded, or had lost its
// connection, finds it again.

const ELSEWHERE = 4000; // the code of a socket that is closed because the visitor has come once more
const token = new URLSearchParams(location.search).get("token");
const query = (fields) => new URLSearchParams(token ? { ...fields, token } : fields).toString();
const visit = sessionStorage.visit ??= Array.from(
  crypto.getRandomValues(new Uint8Array(12)), (byte) => byte.toString(16).padStart(2, "0")).join("");
let socket, waiting = [];

// What the world model is like.
export async function describe() {
  return (await answered(await fetch(`world?${query({})}`))).json();
}

// Call `opened` whenever there is a connection, and `failed` with what is wrong.
export function connect(opened, failed) {
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(`${scheme}//${location.host}/drive?${query({ visit })}`);
  socket.onopen = opened;
  socket.onmessage = (event) => {
    const answer = JSON.parse(event.data), { done, refuse } = waiting.shift();
    answer.error ? refuse(new Error(answer.error)) : done(answer);
  };
  socket.onclose = (event) => {
    const lost = waiting;
    waiting = [];
    lost.forEach(({ refuse }) => refuse(new Error("the connection was lost")));
    setTimeout(() => {
      if (event.code === ELSEWHERE) {
        failed(new Error("this drive was opened in another tab; reload to go on here"));
        return;
      }
      failed(new Error("no connection; trying again…"));
      setTimeout(() => connect(opened, failed), 1000);
    }, 0);
  };
}

// Send a message, one of `Visit.answer`, and return its answer.
export function ask(message) {
  return new Promise((done, refuse) => {
    if (socket.readyState !== WebSocket.OPEN) { refuse(new Error("no connection")); return; }
    waiting.push({ done, refuse });
    socket.send(JSON.stringify(message));
  });
}

// Send pictures, and return the place that they make.
export async function upload(form) {
  return (await answered(await fetch(`picture?${query({})}`, { method: "POST", body: form }))).json();
}

async function answered(response) {
  if (!response.ok) throw new Error(await response.text());
  return response;
}

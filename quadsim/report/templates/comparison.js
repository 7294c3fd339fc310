// Videos: one button plays all; the first leads, and one that drifts is set right.
const videos = [...document.querySelectorAll("video")];
const button = document.getElementById("play-all");

function playAll() {
  const playing = videos.some((video) => !video.paused);
  if (playing) return videos.forEach((video) => video.pause());
  const start = videos[0].ended ? 0 : videos[0].currentTime;
  videos.forEach((video) => {
    video.currentTime = Math.min(start, video.duration || start);
    video.play().catch(() => {}); // paused again before it had begun
  });
}

function followLeader() {
  const [leader, ...others] = videos;
  for (const video of others) {
    if (!video.ended && Math.abs(video.currentTime - leader.currentTime) > 0.15) video.currentTime = leader.currentTime;
  }
}

if (button) {
  button.addEventListener("click", playAll);
  videos[0].addEventListener("timeupdate", followLeader);
  for (const video of videos) {
    for (const event of ["play", "pause"]) {
      video.addEventListener(event, () => {
        button.textContent = videos.some((each) => !each.paused) ? "Pause all" : "Play all together";
      });
    }
  }
}

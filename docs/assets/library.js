// The library: films get their controls, and its table a field; rows that lack one of its words are hidden.
document.querySelectorAll(".films video").forEach((film) => {
  Object.assign(film, { controls: true, muted: true, loop: true, playsInline: true });
  film.addEventListener("error", () => {
    document.querySelector(".no-films").hidden = false;
  });
});
document.querySelectorAll(".library").forEach((library) => {
  const field = document.createElement("input");
  field.type = "search";
  field.placeholder = "Filter by name, topic, verdict, word: wind violated";
  field.setAttribute("aria-label", field.placeholder);
  field.addEventListener("input", () => {
    const words = field.value.toLowerCase().split(/\s+/);
    library.querySelectorAll("tbody tr").forEach((row) => {
      row.hidden = !words.every((word) => row.textContent.toLowerCase().includes(word));
    });
  });
  library.prepend(field);
});

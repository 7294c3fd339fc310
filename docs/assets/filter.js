// A field above the library's table; rows that lack one of its words are hidden.
document.querySelectorAll(".library").forEach((library) => {
  const field = document.createElement("input");
  field.type = "search";
  field.placeholder = "Filter by name, topic, verdict, word: robust wind violated";
  field.setAttribute("aria-label", field.placeholder);
  field.addEventListener("input", () => {
    const words = field.value.toLowerCase().split(/\s+/);
    library.querySelectorAll("tbody tr").forEach((row) => {
      row.hidden = !words.every((word) => row.textContent.toLowerCase().includes(word));
    });
  });
  library.prepend(field);
});

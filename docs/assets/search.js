// Takes the words that say nothing out of a question before it is looked up: the search would add an asterisk to each,
// and `a*` finds half of all pages. A message of another kind, or of another release of the theme, passes as it is.

const QUERY = 2; // the kind of message that carries what was typed
const NOTHING = new Set((
  "a an and are as at be but by can do does for from happens how i if in is it me my of on or so that the then there " +
  "this to want was what when where which who why will with you"
).split(" "));
const post = Worker.prototype.postMessage;

Worker.prototype.postMessage = function (message, ...rest) {
  if (message?.type === QUERY && typeof message.data === "string") {
    const words = message.data.split(/\s+/).filter((word) => !NOTHING.has(word.toLowerCase()));
    if (words.some(Boolean)) message = { ...message, data: words.join(" ") };
  }
  return post.call(this, message, ...rest);
};
